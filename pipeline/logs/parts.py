"""Which files are parts of one recording: recorders of ROS 2 split a bag and name its parts in `metadata.yaml`.

Names alone never join files: `run_0.mcap` and `run_1.mcap` may be two missions.
"""

import functools
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

METADATA_NAME: Final = "metadata.yaml"
LOG_ENDINGS: Final = (".mcap", ".mcap.zstd", ".mcap.zst")
"""Endings of logs; the longer ones are those of logs that are compressed as a whole."""
_MAX_METADATA_BYTES: Final = 2**24
_MAX_NAME_BYTES: Final = 200
"""File systems hold names of 255 bytes; results of a mission append up to 30 to its name."""

_LIST: Final = re.compile(r"^( *)relative_file_paths: *\n((?:\1 *- .*\n?)+)", re.MULTILINE)
_NUMBERED: Final = re.compile(r"(.+)_\d+")


def group_parts(paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """The missions among `paths`, in the order of their first paths, each as its parts in the order of the recording.

    A folder with `metadata.yaml` stands for the parts that are named there and present. Files that the `metadata.yaml`
    beside them names together belong together; every other path is a mission of its own. Repetitions are left out.
    """
    given = [part for path in paths for part in recorded_parts(path) or (path,)]
    places: dict[Path, Path] = {}
    for path in given:
        places.setdefault(path.resolve(), path)
    numbers = functools.cache(_numbers)
    groups: dict[Path, dict[Path, int]] = {}
    for place, path in places.items():
        number = numbers(path.parent).get(path.name)
        groups.setdefault(place if number is None else path.parent.resolve(), {})[path] = number or 0
    return [tuple(sorted(group, key=group.__getitem__)) for group in groups.values()]


def recorded_parts(folder: Path) -> tuple[Path, ...]:
    """The files that `folder/metadata.yaml` names and that are there; empty where there are none."""
    return tuple(folder / name for name in _numbers(folder) if (folder / name).is_file())


def missing_parts(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Files that the `metadata.yaml` beside one of `paths` names as parts of the same recording, but that are not there."""
    absent: dict[Path, None] = {}
    for folder in dict.fromkeys(path.parent for path in paths):
        names = _numbers(folder)
        if any(path.name in names for path in paths if path.parent == folder):
            absent |= {folder / name: None for name in names if not (folder / name).is_file()}
    return tuple(absent)


def named_parts(text: str) -> list[str]:
    """Names of the parts in the order of the recording, as the text of a `metadata.yaml` states them."""
    match = _LIST.search(text)
    lines = match[2].splitlines() if match else []
    # Old recorders wrote the name of the folder, too; a path that leads elsewhere is not followed.
    names = (Path(line.strip()[1:].strip().strip("'\"")).name for line in lines)
    return list(dict.fromkeys(name for name in names if name))


def log_stem(name: str) -> str:
    """The name of a log without its ending."""
    return next((name.removesuffix(ending) for ending in reversed(LOG_ENDINGS) if name.endswith(ending)), Path(name).stem)


def mission_name(paths: Sequence[Path]) -> str:
    """What a mission of these parts is called: the stem of the only part, or what the numbered parts have in common.

    A name that is too long to be appended to is cut, with a hash of the whole.
    """
    stems = [log_stem(path.name) for path in paths]
    matches = [_NUMBERED.fullmatch(stem) for stem in stems]
    common = {match[1] for match in matches if match}
    return _fitting(common.pop() if len(stems) > 1 and None not in matches and len(common) == 1 else stems[0])


def _fitting(name: str) -> str:
    encoded = os.fsencode(name)
    if len(encoded) <= _MAX_NAME_BYTES:
        return name
    return encoded[:_MAX_NAME_BYTES].decode(errors="ignore") + "-" + hashlib.sha256(encoded).hexdigest()[:8]


def _numbers(folder: Path) -> Mapping[str, int]:
    """The parts in the order of `metadata.yaml`, numbered; empty where there is none that can be read.

    A part that was compressed or unpacked since is meant by the name that it has.
    """
    try:
        with (folder / METADATA_NAME).open(encoding="utf-8") as file:
            names = named_parts(file.read(_MAX_METADATA_BYTES))
    except (OSError, ValueError):
        return {}
    return {_present(folder, name): number for number, name in enumerate(names)}


def _present(folder: Path, name: str) -> str:
    """The name under which a log is there, packed or not; `name` itself where it is not there at all."""
    if not name.endswith(LOG_ENDINGS):
        return name
    return next((other for ending in LOG_ENDINGS if (folder / (other := log_stem(name) + ending)).is_file()), name)
