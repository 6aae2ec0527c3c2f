"""Files that are no MCAP: what they are by their first bytes, and the way on."""

import re
from pathlib import Path

HEAD_BYTES = 512

CONVERT = "`rosbags-convert --src {source} --dst {stem}_mcap --dst-storage mcap`, and give the folder {stem}_mcap"
"""How recordings of ROS become logs; the tool comes with a package that we need."""

_KINDS = {
    b"#ROSBAG": f"a ROS 1 bag; convert it with {CONVERT}",
    b"SQLite ": f"a rosbag2 in SQLite; convert its folder with {CONVERT}",
    b"PAR1": "a Parquet file; docs/formats.md shows how to write a table as a log",
    b"\x1f\x8b": "compressed with gzip; unpack it first",
    b"\x28\xb5\x2f\xfd": "compressed with zstd; unpack it first",
    b"PK\x03\x04": "a ZIP archive; unpack it first",
    b"\x89MCAP": "an MCAP of another version, or one whose line ends a copy has changed; copy it in binary mode",
}
_TABLE = re.compile(rb"[\x20-\x7e\x80-\xff]*[,;\t][\x20-\x7e\x80-\xff,;\t]*\r?\n")
_UNKNOWN = "something else; if it was one, copy it again from where it was recorded"


def kind_of(path: Path, head: bytes) -> str:
    """What the file with the first bytes `head` is, and what to do with it."""
    words = next((text for magic, text in _KINDS.items() if head.startswith(magic)), None)
    if words is None:
        is_table = _TABLE.match(head) is not None
        words = (
            "a table as text; docs/formats.md shows how to write it as a log"
            if is_table
            else "something else; if it was one, copy it again from where it was recorded"
        )
    return words.format(source=path.parent if head.startswith(b"SQLite ") else path, stem=path.stem)


def recordings_below(folder: Path) -> str:
    """What in a folder without logs are recordings of another kind, and the way on; empty where there is none."""
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".bag", ".db3", ".csv", ".gz", ".zst", ".zip") and path.is_file():
            with path.open("rb") as file:
                return f"{path.relative_to(folder)} is {kind_of(path, file.read(HEAD_BYTES))}"
    return ""
