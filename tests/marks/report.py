"""What tests ran, as coverage.py writes it: python tests/marks/report.py out/coverage.json."""

import sys
from pathlib import Path

from coverage import Coverage, CoverageData
from line_marks import MARKS, PROJECT, SOURCES, Marked, file_of


def covered(path: Path) -> list[int]:
    """Lines of a source file that were run; none where nothing imported it."""
    name = path.relative_to(PROJECT).as_posix()
    runs = Marked(path.read_bytes(), name).lines
    marks = file_of(name).read_bytes() if file_of(name).exists() else bytes(len(runs))
    return sorted({line for lines, mark in zip(runs, marks, strict=True) if mark for line in lines})


def main(report: str) -> None:
    """Write the report, of every source file."""
    files = [
        file for name in SOURCES for file in ((PROJECT / name).rglob("*.py") if (PROJECT / name).is_dir() else [PROJECT / name])
    ]
    (MARKS / "data").unlink(missing_ok=True)
    data = CoverageData(str(MARKS / "data"))
    data.add_lines({str(file): covered(file) for file in files})
    data.write()
    coverage = Coverage(data_file=str(MARKS / "data"), config_file=False)
    coverage.load()
    coverage.json_report(outfile=report)


if __name__ == "__main__":
    main(sys.argv[1])
