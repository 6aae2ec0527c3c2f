"""The altitude chart of the report: rows for agents whose height is known, and no section without any."""

import re
from pathlib import Path

from fixtures.heights import add_heights
from fixtures.mission import build_mission

from pipeline.progress import Progress
from pipeline.report.charts import LABEL_WIDTH
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
    drawn = re.findall(r'class="heights past" points="([^"]*)"', section)
    assert drawn and min(float(point.split(",")[0]) for line in drawn for point in line.split()) >= LABEL_WIDTH
    assert "-0 m" not in section
    report(directory, ReportConfig(), Progress(quiet=True))
    page = (directory / "report.html").read_text()
    assert "Height over time" in page and "mean rate hz" not in page and "height.noise" not in page


def test_without_heights_there_is_no_chart(tmp_path: Path) -> None:
    assert height_section(load_mission(build_mission(tmp_path))) == ""
