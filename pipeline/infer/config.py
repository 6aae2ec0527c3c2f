"""The settings of the infer stage."""

from dataclasses import dataclass, field

from cadence.association.types import AssociationConfig
from cadence.diffusion.settings import AbsoluteSampling, GuidanceConfig, PlaceSampling, SamplerName
from cadence.evidence.settings import WeighingConfig
from pipeline.checkpoints import DEFAULT
from pipeline.estimators.samplings import GeneralSampling, Samplings
from pipeline.grids import GridConfig


@dataclass(frozen=True)
class InferConfig:
    """How hypotheses are drawn. What the preset of the checkpoint does not read is refused unless it is left at its default.

    num_hypotheses   for each window
    seed             of all random numbers
    checkpoint       a .safetensors file, the name of a shipped one, or "none" for the bank alone
    sampler          of the general preset: "rotation" (by default), "ddim" or "dpmpp"
    num_steps        of the general preset: evaluations of the network a hypothesis; 6 by default
    default_sigma_m  accuracy of detections that state none
    device           "auto", "cpu" or "cuda"
    paper            how a checkpoint of the paper preset is sampled; it brings its own grid
    place            how a checkpoint of the place preset is sampled; it brings its own grid. Its older name, scene, is still
                     read
    is_gated         of the general preset: the network moves as many of the hypotheses as withheld detections of this log
                     advise
    is_tested        a checkpoint that adapts to no log is tested on later detections of this one; where it does not fit,
                     hypotheses are drawn with the default checkpoint instead
    is_strict        refuse a log that the checkpoint does not fit (`--strict`)
    is_associated    detections of unknown origin are told apart; otherwise they are taken for one agent called "unknown"
    association      how they are told apart
    evidence         how hypotheses are weighed by what else speaks about tracks
    """

    num_hypotheses: int = 30
    seed: int = 0
    checkpoint: str = DEFAULT
    sampler: SamplerName | None = None
    num_steps: int | None = None
    default_sigma_m: float = 0.0
    device: str = "auto"
    is_gated: bool = True
    is_tested: bool = True
    is_strict: bool = False
    is_associated: bool = True
    association: AssociationConfig = field(default_factory=AssociationConfig)
    grid: GridConfig = field(default_factory=GridConfig)
    evidence: WeighingConfig = field(default_factory=WeighingConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    paper: AbsoluteSampling = field(default_factory=AbsoluteSampling)
    place: PlaceSampling = field(default_factory=PlaceSampling, metadata={"older_name": "scene"})

    def __post_init__(self) -> None:
        is_few = self.num_hypotheses < 1 or (self.num_steps is not None and self.num_steps < 1)
        if is_few or self.default_sigma_m < 0:
            raise ValueError("num_hypotheses and num_steps must be at least 1, default_sigma_m not negative")

    @property
    def samplings(self) -> Samplings:
        """What checkpoints are loaded with."""
        default = GeneralSampling()
        general = GeneralSampling(self.sampler or default.sampler, self.num_steps or default.num_steps, self.is_gated)
        return Samplings(general, self.paper, self.place, self.guidance, self.device)
