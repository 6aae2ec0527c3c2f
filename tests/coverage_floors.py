"""Holds the coverage of every package against its floor in pyproject.toml.

After `make test`, python tests/coverage_floors.py out/coverage.json --raise writes the table anew: floors rise to what was
measured, new packages get one, packages that are gone lose theirs. No floor is lowered.
"""

import json
import sys
import tomllib
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
TABLE = "tool.cadence.coverage_floors"
RECORDINGS = PROJECT.parent.parent / "shared" / "data"

ROOM = 0.5
"""Points that machines may differ by: some lines are for what only some processors or schedules do."""

ROOM_WITHOUT_RECORDINGS = 3.0
"""Tests that need recorded logs are skipped where there are none."""


def measured_percent(report: Mapping[str, Any]) -> dict[str, float]:
    """Covered lines of every folder of the report, and of files at the top, in per cent, where there are statements."""
    covered: dict[str, int] = defaultdict(int)
    statements: dict[str, int] = defaultdict(int)
    for name, file in report["files"].items():
        folder = name.rpartition("/")[0] or name
        covered[folder] += file["summary"]["covered_lines"]
        statements[folder] += file["summary"]["num_statements"]
    return {folder: 100.0 * covered[folder] / count for folder, count in sorted(statements.items()) if count}


def complaints(measured: Mapping[str, float], floors: Mapping[str, int], room: float = 0.0) -> list[str]:
    """One line for each package that is more than `room` below its floor or has none, and for each floor without a package."""
    found = []
    for package, percent in measured.items():
        if package not in floors:
            found.append(f'{package}: no floor; add "{package}" = {int(percent)} to [{TABLE}]')
        elif percent < floors[package] - room:
            found.append(f"{package}: {percent:.1f} % of its lines are tested, the floor is {floors[package]} %; add tests")
    gone = floors.keys() - measured.keys()
    return found + [f"{package}: there is no such package; take its floor out of [{TABLE}]" for package in sorted(gone)]


def raised(project: str, measured: Mapping[str, float]) -> str:
    """The text of pyproject.toml with higher floors; the table is its last."""
    floors = floors_of(project)
    before, header, table = project.partition(f"[{TABLE}]\n")
    comments = "".join(line for line in table.splitlines(keepends=True) if line.startswith("#"))
    rows = [f'"{package}" = {max(int(percent), floors.get(package, 0))}\n' for package, percent in measured.items()]
    return before + header + comments + "".join(rows)


def floors_of(project: str) -> dict[str, int]:
    """The table in the text of pyproject.toml."""
    return dict(tomllib.loads(project)["tool"]["cadence"]["coverage_floors"])


def main(report: Path, *options: str) -> int:
    """Print the table and what is wrong; the exit status."""
    measured = measured_percent(json.loads(report.read_text(encoding="utf-8")))
    if options == ("--raise",):
        PROJECT.write_text(raised(PROJECT.read_text(encoding="utf-8"), measured), encoding="utf-8")
    floors = floors_of(PROJECT.read_text(encoding="utf-8"))
    for package, percent in measured.items():
        print(f"{package:<26} {percent:6.2f} %   floor {floors.get(package, '-')}")
    has_recordings = RECORDINGS.is_dir()
    if not has_recordings:
        print(f"No recorded logs in ../shared/data: floors are held with {ROOM_WITHOUT_RECORDINGS:g} points of room.")
    wrong = complaints(measured, floors, ROOM if has_recordings else ROOM_WITHOUT_RECORDINGS)
    print("\n".join(wrong), file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), *sys.argv[2:]))
