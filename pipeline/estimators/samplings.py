"""How checkpoints of every preset are sampled: what a stage hands on of its settings when it loads one."""

from dataclasses import dataclass, field

from cadence.diffusion.settings import AbsoluteSampling, GuidanceConfig, PlaceSampling, SamplerName


@dataclass(frozen=True)
class GeneralSampling:
    """How a checkpoint of the general preset is sampled.

    sampler, num_steps  see `cadence.diffusion.general.GeneralModel`
    is_gated            the network moves all, half or none of the hypotheses, as withheld detections of the log advise
    """

    sampler: SamplerName = "rotation"
    num_steps: int = 6
    is_gated: bool = True


@dataclass(frozen=True)
class Samplings:
    """Settings by preset, and those that concern several.

    guidance  how constraints act (general, and as far as it says so, place)
    device    where networks run
    """

    general: GeneralSampling = field(default_factory=GeneralSampling)
    paper: AbsoluteSampling = field(default_factory=AbsoluteSampling)
    place: PlaceSampling = field(default_factory=PlaceSampling)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    device: str = "auto"
