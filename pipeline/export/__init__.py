"""Results of a mission as MCAP channels that open in Foxglove, and back."""

from pipeline.export.messages import read_hypotheses
from pipeline.export.stage import ExportConfig, export

__all__ = ["ExportConfig", "export", "read_hypotheses"]
