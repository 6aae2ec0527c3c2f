"""What processes with sitecustomize.py ran, as coverage.py reports it: line_report.py out/lines out/coverage.json."""

import json
import sys
from collections import defaultdict
from pathlib import Path

from coverage import Coverage, CoverageData

PROJECT = Path(__file__).resolve().parents[2]


def main(folder: Path, report: str) -> None:
    """Write the report of every source file, also of those that nothing imported."""
    lines: dict[str, set[int]] = defaultdict(set)
    for part in folder.glob("*.json"):
        for name, ran in json.loads(part.read_text(encoding="utf-8")).items():
            lines[str(PROJECT / name)].update(ran)
    sources = [PROJECT / "cli.py"]
    for name in ("cadence", "pipeline", "schemas"):
        sources += (PROJECT / name).rglob("*.py")
    data = CoverageData(str(folder / "data"))
    data.erase()
    data.add_lines({str(file): lines[str(file)] for file in sources})
    data.write()
    coverage = Coverage(data_file=str(folder / "data"), config_file=False)
    coverage.load()
    coverage.json_report(outfile=report)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
