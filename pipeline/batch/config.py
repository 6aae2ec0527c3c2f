"""The settings of `cadence run`."""

from dataclasses import dataclass, field

from pipeline.export.config import ExportConfig
from pipeline.extract.config import ExtractConfig
from pipeline.infer.config import InferConfig
from pipeline.ingest.stage import IngestConfig
from pipeline.report.config import ReportConfig


@dataclass(frozen=True)
class RunConfig:
    """The configuration of every stage of `cadence run`: the tables [ingest], [extract], [infer], [export], [report]."""

    ingest: IngestConfig = field(default_factory=IngestConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)
    infer: InferConfig = field(default_factory=InferConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
