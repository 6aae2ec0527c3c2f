"""The altitude chart of the report: rows for agents whose height is known, and no section without any."""

from pathlib import Path

from fixtures.heights import add_heights
from fixtures.mission import build_mission

from pipeline.progress import Progress
from pipeline.report.config import ReportConfig
from pipeline.report.heights import height_section
from pipeline.report.mission import load_mission
from pipeline.report.stage import report


def test_the_report_shows_heights(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    add_heights(directory)
    section = height_section(load_mission(directory))
    assert "Height over time" in section and "above sea level" in section
    assert section.count('<text class="name"') == 1, "T1 has no height"
    assert section.count('class="heights past"') >= 6 and section.count('<polygon class="heights future"') == 1
    assert section.count('<circle class="detection"') == 24 + 1, "detections, and the legend"
    report(directory, ReportConfig(), Progress(quiet=True))
    assert "Height over time" in (directory / "report.html").read_text()


def test_without_heights_there_is_no_chart(tmp_path: Path) -> None:
    assert height_section(load_mission(build_mission(tmp_path))) == ""
