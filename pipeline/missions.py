"""Which logs are meant, which of them are one mission, and which mission directory belongs to which."""

import glob
import hashlib
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

from cadence.errors import CadenceError, InputError, UsageError
from pipeline.counted import counted
from pipeline.documents import parse_json
from pipeline.logs.foreign import recordings_below
from pipeline.logs.parts import LOG_ENDINGS, METADATA_NAME, group_parts, log_stem, mission_name, named_parts
from pipeline.stores.objects import StoredObject, find_objects, read_bytes
from pipeline.stores.urls import is_url, shown, url_name

CATALOGUE_NAME: Final = "catalogue.json"
"""What ingest leaves in a mission directory (`pipeline.catalogue`): by it one is known."""

REPORT_NAME: Final = "batch.json"
"""What became of a batch, beside its mission directories."""

_TAKEN_NAMES: Final = (REPORT_NAME, "scores.json", "scores.csv", "scores.md")
"""Files beside mission directories: a log may be called batch.json.mcap."""

_SIDE_ENDING: Final = ".cadence.mcap"
_OWN_ENDINGS: Final = (_SIDE_ENDING, ".combined.mcap")


@dataclass(frozen=True)
class Mission:
    """The parts of one mission in the order of the recording, its mission directory, and the size of all parts (0: unknown).

    Parts and directory are paths or URLs.
    """

    parts: tuple[str, ...]
    directory: str
    size_bytes: int


def no_mission(path: Path) -> InputError:
    """What is said of a path that is no mission directory, with the way on."""
    if path.is_file():
        on = f"; `cadence run {path} --out results` makes one of a log" if _is_log_name(path.name) else ""
        return InputError(f"{path}: is a file, not a mission directory{on}")
    inside = sorted(catalogue.parent for catalogue in path.glob(f"*/{CATALOGUE_NAME}"))
    if inside:
        held = counted(len(inside), "mission directory", "mission directories")
        return InputError(f"{path}: holds {held}; name one, such as {inside[0]}")
    seen = f"holds no {CATALOGUE_NAME}, so it is no mission directory" if path.is_dir() else "not found"
    return InputError(f"{path}: {seen}; `cadence run LOG --out results` makes one, results/NAME")


def find_missions(logs: Sequence[str], out: str) -> tuple[Mission, ...]:
    """The missions among files, folders (searched through), patterns and URLs, each once, in the order given, URLs last.

    `UsageError` where nothing is given, `InputError` where a folder or a pattern holds no log.
    """
    if not logs:
        raise UsageError("no log given; name at least one MCAP file")
    texts = [text.removeprefix("file://") for text in logs]
    paths = [path for text in texts if not is_url(text) for path in _paths(text)]
    sizes = {found.url: found.size_bytes for text in texts if is_url(text) for found in _objects(text)}
    groups = [*(tuple(map(str, group)) for group in group_parts(paths)), *_group_objects(list(sizes))]
    sizes |= {str(path): path.stat().st_size for path in map(Path, itertools.chain(*groups)) if path.is_file()}
    return tuple(
        Mission(group, directory, sum(sizes.get(part, 0) for part in group))
        for group, directory in zip(groups, _directories(groups, out), strict=True)
    )


def mission_directories(logs: Sequence[Path], out: Path) -> dict[Path, Path]:
    """The mission directory of every distinct log, in the order given: `out`/<stem of the log>.

    Logs in different folders may share a stem: each of those gets its place's hash as a suffix, in whichever order they are
    given. A log that is given twice is run once. What was run earlier stays where it is.
    """
    if not logs:
        raise UsageError("no log given; name at least one MCAP file")
    distinct = {log.resolve(): log for log in reversed(logs)}
    groups = [(str(log),) for log in dict.fromkeys(log.resolve() for log in logs)]
    return {distinct[Path(log)]: Path(found) for (log,), found in zip(groups, _directories(groups, str(out)), strict=True)}


def is_mission_directory(path: Path) -> bool:
    """Whether a log was ingested into `path`, as opposed to a folder of mission directories."""
    return (path / CATALOGUE_NAME).is_file()


def _paths(text: str) -> Iterator[Path]:
    """The files that one argument means. A path that leads nowhere stays: its own failure will say so."""
    path = Path(text)
    if path.is_dir():
        yield from _logs_below(path) or _refused(path)
    elif path.name.endswith(_SIDE_ENDING):
        raise InputError(f"{text}: was written by cadence export; name the log that it belongs to")
    elif path.exists() or not glob.has_magic(text):
        yield path
    else:
        found = [Path(name) for name in sorted(glob.glob(text, recursive=True))]  # noqa: PTH207 (Path.glob: no absolute ones)
        logs = [log for each in found for log in (_logs_below(each) if each.is_dir() else [each] if _is_log(each) else [])]
        if not logs:
            raise InputError(f"{text}: no MCAP log fits this pattern; correct it")
        yield from logs


def _refused(folder: Path) -> NoReturn:
    """Says of a folder without logs what it is instead, and the way on."""
    if is_mission_directory(folder):
        log = _ingested_log(folder)
        raise InputError(f"{folder}: is a mission directory, not a folder of logs; its log is {log or 'a fetched one'}")
    foreign = recordings_below(folder)
    if foreign:
        raise InputError(f"{folder}: holds no MCAP log; {foreign}")
    raise InputError(f"{folder}: holds no MCAP log; name a log or another folder")


def _objects(url: str) -> tuple[StoredObject, ...]:
    """The logs that a URL means: an object, all below a prefix, or what fits a pattern; and `metadata.yaml` beside them."""
    found = find_objects(url, lambda name: _is_log_name(name) or name.rpartition("/")[2] == METADATA_NAME)
    if all(each.name == METADATA_NAME for each in found):
        raise InputError(f"{shown(url)}: holds no MCAP log; check the URL")
    return found


def _group_objects(urls: Sequence[str]) -> list[tuple[str, ...]]:
    """The missions among logs in stores, with their parts as in `group_parts`.

    Where the listing of a folder holds `metadata.yaml`, every part that it names belongs to the mission: one that is not in
    the store fails it, rather than be missed by nobody.
    """
    logs = [url for url in urls if url_name(url) != METADATA_NAME]
    num_logs = Counter(map(_folder, logs))
    listed = {_folder(url) for url in urls if url_name(url) == METADATA_NAME}
    named = {folder: _named_in(folder, folder in listed) for folder in num_logs if num_logs[folder] > 1 or folder in listed}
    groups: dict[str, dict[str, str]] = {}
    for url in logs:
        is_part = url_name(url) in named.get(_folder(url), ())
        groups.setdefault(_folder(url) if is_part else url, {})[url_name(url)] = url
    for folder, group in groups.items():
        absent = [name for name in named.get(folder, ()) if name not in group and folder in listed]
        group |= {name: f"{folder}/{name}" for name in absent if _is_log_name(name)}
    return [tuple(group[name] for name in named.get(folder, group) if name in group) for folder, group in groups.items()]


def _folder(url: str) -> str:
    """What a URL stands in; of a web address with a query, which may be good for one object only, the address itself."""
    return url.rpartition("/")[0] if shown(url) == url else url


def _named_in(folder: str, is_listed: bool) -> list[str]:
    """The parts that `metadata.yaml` in a folder of a store names; empty where there is none."""
    try:
        return named_parts(read_bytes(f"{folder}/{METADATA_NAME}").decode("utf-8", "replace"))
    except CadenceError:  # a store that does not let us look whether there is one has none
        if is_listed:
            raise
        return []


def _logs_below(folder: Path) -> list[Path]:
    """All logs in `folder` and below it, by their paths; not what CADENCE wrote, and nothing hidden.

    Of a log that was unpacked beside its compressed form, the plain one.
    """
    found = sorted(path for path in folder.rglob("*.mcap*") if path.name.endswith(LOG_ENDINGS) and _is_log(path, folder))
    plain = {path for path in found if path.suffix == ".mcap"}
    return [path for path in found if path in plain or path.with_name(f"{log_stem(path.name)}.mcap") not in plain]


def _is_log(path: Path, folder: Path | None = None) -> bool:
    inner = path.relative_to(folder) if folder is not None else Path(path.name)
    return path.is_file() and not _is_own(path.name) and not any(part.startswith(".") for part in inner.parts)


def _is_log_name(name: str) -> bool:
    """The same of a name in a store."""
    is_hidden = any(part.startswith(".") for part in name.split("/"))
    return name.endswith(LOG_ENDINGS) and not _is_own(name) and not is_hidden


def _is_own(name: str) -> bool:
    """Whether CADENCE wrote it."""
    return f"{log_stem(name)}.mcap".endswith(_OWN_ENDINGS)


def _place(part: str) -> Path:
    """Where a part lies, as a path that also URLs have: only its names matter."""
    return Path(shown(part)).parent / url_name(part) if is_url(part) else Path(part).resolve()


def _directories(groups: Sequence[tuple[str, ...]], out: str) -> list[str]:
    """`out`/<name of the mission>; with a hash of where the first part lies, where others share the name.

    Others: among the missions given, or one that was run into that directory earlier and whose log still exists, or a file
    that lies beside mission directories. The mission whose results are there already keeps the plain name.
    """
    places = [[_place(part) for part in group] for group in groups]
    names = [mission_name(group) for group in places]
    counts = Counter(names)
    found = []
    for name, (place, *_) in zip(names, places, strict=True):
        plain = f"{out.rstrip('/') or '/'}/{name}"
        holder = None if is_url(out) else _ingested_log(Path(plain))
        is_shared = counts[name] > 1 or (holder is not None and holder.exists())
        is_shared |= name in _TAKEN_NAMES
        suffix = "-" + hashlib.sha256(str(place).encode()).hexdigest()[:8]
        found.append(plain + suffix if is_shared and holder != place else plain)
    return found


def _ingested_log(directory: Path) -> Path | None:
    """The log whose results a mission directory holds; None where it holds none, or the log was fetched for it."""
    try:
        path = Path(parse_json((directory / CATALOGUE_NAME).read_text(encoding="utf-8"))["path"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return path if path.is_absolute() else None
