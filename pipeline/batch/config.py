"""The settings of `cadence run`."""

from dataclasses import dataclass, field

from pipeline.export.config import ExportConfig
from pipeline.extract.config import ExtractConfig
from pipeline.infer.config import InferConfig
from pipeline.ingest.stage import IngestConfig
from pipeline.report.config import ReportConfig
from pipeline.retrospect.config import RetrospectConfig


@dataclass(frozen=True)
class RunConfig:
    """The configuration of every stage of `cadence run`, a table each: [ingest], [extract], [infer] and so on."""

    ingest: IngestConfig = field(default_factory=IngestConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)
    infer: InferConfig = field(default_factory=InferConfig)
    retrospect: RetrospectConfig = field(default_factory=RetrospectConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
