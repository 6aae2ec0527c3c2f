"""Files that are no MCAP: what they are by their first bytes, and the way on."""

import re
import shlex
from pathlib import Path

HEAD_BYTES = 512

CONVERT = "`rosbags-convert --src {source} --dst {stem}_mcap --dst-storage mcap`, and give the folder {stem}_mcap"
"""How recordings of ROS become logs; the tool comes with a package that we need."""

IMPORT = "`cadence import {source} --out {stem}.mcap` makes a log of its positions"
"""How tables become logs."""

_KINDS = {
    b"#ROSBAG": f"a ROS 1 bag; convert it with {CONVERT}",
    b"SQLite ": f"a rosbag2 in SQLite; convert its folder with {CONVERT}",
    b"PAR1": f"a Parquet file; {IMPORT}",
    b"\x1f\x8b": "compressed with gzip; unpack it first",
    b"\x28\xb5\x2f\xfd": "compressed with zstd; unpack it first",
    b"PK\x03\x04": "a ZIP archive; unpack it first",
    b"\x89MCAP": "an MCAP of another version, or one whose line ends a copy has changed; copy it in binary mode",
}
_TABLE = re.compile(rb"[\x20-\x7e\x80-\xff]*[,;\t][\x20-\x7e\x80-\xff,;\t]*\r?\n")
_GEOJSON = re.compile(rb'\s*(\xef\xbb\xbf)?\s*[\{\[].*"(FeatureCollection|Feature|features)"', re.DOTALL)
_UNKNOWN = "something else; if it was one, copy it again from where it was recorded"
_ENDINGS = (".bag", ".db3", ".csv", ".parquet", ".geojson", ".gz", ".zst", ".zip")


def kind_of(path: Path, head: bytes) -> str:
    """What the file with the first bytes `head` is, and what to do with it."""
    words = next((text for magic, text in _KINDS.items() if head.startswith(magic)), None)
    if words is None and _GEOJSON.match(head) is not None:
        words = f"GeoJSON; {IMPORT}"
    if words is None:
        words = f"a table as text; {IMPORT}" if _TABLE.match(head) is not None else _UNKNOWN
    source = path.parent if head.startswith(b"SQLite ") else path
    return words.format(source=shlex.quote(str(source)), stem=shlex.quote(path.stem))


def recordings_below(folder: Path) -> str:
    """What in a folder without logs are recordings of another kind, and the way on; empty where there is none."""
    for path in sorted(folder.rglob("*")):
        if path.suffix in _ENDINGS and path.is_file():
            with path.open("rb") as file:
                return f"{path.relative_to(folder)} is {kind_of(path, file.read(HEAD_BYTES))}"
    return ""
