"""The report stage: one self-contained HTML page a mission, which needs neither network nor server to be read."""

from pipeline.report.stage import ReportConfig, report

__all__ = ["ReportConfig", "report"]
