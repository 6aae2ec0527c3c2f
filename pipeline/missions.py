"""Which mission directory belongs to which log."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from cadence.errors import UsageError


def mission_directories(logs: Sequence[Path], out: Path) -> dict[Path, Path]:
    """The mission directory of every distinct log, in the order given: `out`/<stem of the log>.

    Logs in different folders may share a stem: each of those gets its folder's hash as a suffix, the same whichever other
    logs are given and in whichever order. A log that is given twice is run once.
    """
    if not logs:
        raise UsageError("no log given; name at least one MCAP file")
    distinct = {log.resolve(): log for log in reversed(logs)}
    stems = [log.stem for log in distinct]
    directories = {}
    for log in dict.fromkeys(log.resolve() for log in logs):
        is_shared = stems.count(log.stem) > 1
        suffix = "-" + hashlib.sha256(str(log).encode()).hexdigest()[:8] if is_shared else ""
        directories[distinct[log]] = out / f"{log.stem}{suffix}"
    return directories


def is_mission_directory(path: Path) -> bool:
    """Whether a log was ingested into `path`, as opposed to a folder of mission directories."""
    return (path / "catalogue.json").is_file()
