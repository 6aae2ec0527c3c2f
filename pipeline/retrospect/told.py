"""What infer was told and what it found, by its manifest: mission hypotheses obey the same."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from cadence.diffusion.settings import GuidanceConfig
from cadence.errors import InputError
from pipeline.checkpoints import DEFAULT
from pipeline.config import read_config
from pipeline.grids import GridConfig
from pipeline.manifest import read_manifest


@dataclass(frozen=True)
class Told:
    """What infer was told and found, by its manifest.

    checkpoint  that drew the windows; preset of it
    """

    checkpoint: str = DEFAULT
    default_sigma_m: float = 0.0
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    grid: GridConfig = field(default_factory=GridConfig)

    @staticmethod
    def of(directory: Path) -> tuple["Told", dict[str, Any]]:
        """The settings, and the summary. `InputError` where infer has left none."""
        manifest = read_manifest("infer", directory) or {}
        config, summary = manifest.get("config"), manifest.get("summary")
        if not isinstance(config, dict) or not isinstance(summary, dict):
            raise InputError(f"{directory}: holds no hypotheses of windows; run `cadence infer`, or `cadence run`, first")
        names = {item.name for item in fields(Told)}
        told = read_config(Told, {name: value for name, value in config.items() if name in names}, "infer.manifest.json")
        return told, summary
