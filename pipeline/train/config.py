"""The settings of the train stage: what every preset is trained on, and for how long."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from cadence.baselines.grammi import GrammiNetworkConfig
from cadence.baselines.mixture import MixtureFrame
from cadence.baselines.vrnn import VrnnNetworkConfig
from cadence.diffusion.absolute import AbsoluteConfig
from cadence.diffusion.place_frame import PlaceConfig
from cadence.network.residual import ResidualNetworkConfig
from cadence.network.trajectory import TrajectoryNetworkConfig
from cadence.recordings import NUM_STEPS
from cadence.training.loop import OptimiserConfig
from cadence.training.place_losses import Dropout
from cadence.training.synthetic import SyntheticConfig
from cadence.worlds.patrol import PatrolConfig
from pipeline.episodes.pool import EpisodeSource
from pipeline.episodes.recordings import RecordingsConfig
from pipeline.extract.config import ExtractConfig


def _patrol() -> PatrolConfig:
    return PatrolConfig(duration_s=21_600.0, step_s=30.0)


@dataclass(frozen=True)
class AbsoluteTraining:
    """What the paper's preset is trained on.

    network        the paper's by default
    step_s         seconds between steps
    history_steps  steps up to and including the origin: 1 in the paper, which predicts only
    context_steps  detections from this many steps before the origin on are read
    relative       positions about the last detection instead of the map's centre
    clip           clean estimates are clamped to it when sampling, in units of half the map
    centre_m, scale_m  the map's centre and half its side; by default from the truth of the training logs
    num_windows    random windows of each episode
    parked_tail    after the end of its truth an agent stays where it was (the paper); otherwise those steps do not count
    max_gap_steps  truth is interpolated between samples that are no further apart
    validation_share  of the logs, whole ones; at least one
    num_episodes, num_validation_episodes  of the simulator
    patrol         the simulator's settings
    sources        episodes of one target to train on, in place of logs and patrol: any number of windows, as in the paper
                   with the first position as a detection and the target parked after the end
    validation     episodes to validate on; without them the last ones of each source (validation_share)
    num_validation_windows  of each source
    hidden_goals   share of the windows of `sources` whose known goal is hidden, for networks with known_goal; more than 0
                   makes a checkpoint that serves with and without
    """

    network: TrajectoryNetworkConfig = field(default_factory=TrajectoryNetworkConfig)
    step_s: float = 60.0
    history_steps: int = 1
    context_steps: int = 4320
    relative: bool = False
    clip: float = 1.0
    centre_m: tuple[float, float] | None = None
    scale_m: float | None = None
    num_windows: int = 64
    parked_tail: bool = True
    max_gap_steps: float = 2.0
    validation_share: float = 0.1
    num_episodes: int = 400
    num_validation_episodes: int = 16
    patrol: PatrolConfig = field(default_factory=_patrol)
    sources: tuple[EpisodeSource, ...] = ()
    validation: tuple[EpisodeSource, ...] = ()
    num_validation_windows: int = 1000
    hidden_goals: float = 0.0

    def __post_init__(self) -> None:
        self.model_config((0.0, 0.0), self.scale_m or 1.0)  # refuses what cannot be
        if min(self.num_windows, self.num_episodes, self.num_validation_episodes, self.num_validation_windows) < 1:
            raise ValueError("num_windows, num_episodes, num_validation_episodes and num_validation_windows must be at least 1")
        if not 0 < self.validation_share < 1 or not self.max_gap_steps > 0 or self.context_steps < self.history_steps:
            raise ValueError("validation_share must lie in 0 ... 1, max_gap_steps be positive, context_steps reach the history")
        if self.network.known_goal and not self.sources:
            raise ValueError("network.known_goal: only episodes of `sources` say where the goal is; train without it")
        if self.validation and not self.sources:
            raise ValueError("validation goes with sources; logs and patrol keep some of their own episodes for it")
        if self.sources and (self.network.num_steps, self.history_steps) != (NUM_STEPS, 1):
            raise ValueError(f"windows of sources have {NUM_STEPS} steps from now on: network.num_steps, history_steps = 1")
        if not 0 <= self.hidden_goals <= 1:
            raise ValueError("hidden_goals must lie in 0 ... 1")
        if self.network.elapsed and self.relative:
            raise ValueError("network.elapsed needs the time since the mission's start, which a relative model does not have")

    def model_config(self, centre_m: tuple[float, float], scale_m: float) -> AbsoluteConfig:
        """The checkpoint's configuration for these map limits."""
        return AbsoluteConfig(
            self.network,
            self.step_s,
            self.history_steps,
            centre_m,
            scale_m,
            self.relative,
            self.clip,
            float(self.context_steps),
            self.network.known_goal and self.hidden_goals > 0,
        )


def _worlds() -> tuple[EpisodeSource, ...]:
    return tuple(EpisodeSource(1.0, RecordingsConfig(set=name, num_episodes=4000)) for name in ("low", "med", "high"))


def _validation() -> tuple[EpisodeSource, ...]:
    return tuple(EpisodeSource(1.0, RecordingsConfig(set=name, num_episodes=50, seed=1)) for name in ("low", "med", "high"))


@dataclass(frozen=True)
class PlaceTraining:
    """What the place preset is trained on, and for what.

    model           sizes, inputs and units; few_steps is set by the objective "energy"
    objective       "diffusion" (noise levels at random), or "energy": a few-step sampler tuned by the energy score
    start           checkpoint that the training starts from; "energy" needs one
    sources         episodes to train on
    validation      episodes to validate on
    num_validation_windows  of each source
    told            which windows are told of the start, the goal and the trackers
    path_weight     of the positions' error beside that of the pieces, for "diffusion"
    few_steps       evaluations of the sampler, for "energy"
    num_samples     tracks a window, for "energy"
    score_weights   of the whole track and of single pieces beside the positions, for "energy"
    """

    model: PlaceConfig = field(default_factory=PlaceConfig)
    objective: Literal["diffusion", "energy"] = "diffusion"
    start: str | None = None
    sources: tuple[EpisodeSource, ...] = field(default_factory=_worlds)
    validation: tuple[EpisodeSource, ...] = field(default_factory=_validation)
    num_validation_windows: int = 1000
    told: Dropout = field(default_factory=Dropout)
    path_weight: float = 1.0
    few_steps: int = 2
    num_samples: int = 4
    score_weights: tuple[float, float] = (0.3, 0.3)

    def __post_init__(self) -> None:
        if not self.sources or not self.validation:
            raise ValueError("sources and validation must name episodes")
        if self.few_steps < 1 or self.num_samples < 2 or self.num_validation_windows < 1:
            raise ValueError("few_steps and num_validation_windows must be at least 1, num_samples at least 2")
        if self.objective == "energy" and self.start is None:
            raise ValueError("the objective 'energy' tunes a trained network: name its checkpoint in start")


@dataclass(frozen=True)
class RivalTraining:
    """How the learned rivals are trained; the defaults are the published values where there are any.

    vrnn, grammi   the networks
    sources        where episodes come from; without any one is simulated as the defaults of a source say
    validation_share  of each source's episodes, whole ones, its last; at least one
    centre_m, scale_m  the map's centre and half its side; by default from the training episodes
    age_scale_steps, elapsed_scale_steps  ages of detections and elapsed time are counted in so many steps
    hidden_goals   share of the windows in which the known goal is hidden
    num_validation_windows  random ones, of the validation episodes
    kl_weight      of the divergence in the VRNN's loss
    mi_weight      of the cross-entropy in GrAMMI's loss
    tuning_steps, tuning_rate  of GrAMMI with mutual information, which goes on from the model without
    start          checkpoint to go on from; a GrAMMI may grow a posterior, and its one trunk may become one for each horizon.
                   GrAMMI with mutual information needs one without, and trains it in the folder without_mi where none is given
    """

    vrnn: VrnnNetworkConfig = field(default_factory=VrnnNetworkConfig)
    grammi: GrammiNetworkConfig = field(default_factory=GrammiNetworkConfig)
    sources: tuple[RecordingsConfig, ...] = ()
    validation_share: float = 0.1
    centre_m: tuple[float, float] | None = None
    scale_m: float | None = None
    age_scale_steps: float = 4320.0
    elapsed_scale_steps: float = 4320.0
    hidden_goals: float = 0.5
    num_validation_windows: int = 4000
    kl_weight: float = 0.01
    mi_weight: float = 2.0
    tuning_steps: int = 4000
    tuning_rate: float = 8e-5
    start: Path | None = None

    def __post_init__(self) -> None:
        if not 0 < self.validation_share < 1 or not 0 <= self.hidden_goals <= 1:
            raise ValueError("validation_share must lie between 0 and 1, hidden_goals in 0 ... 1")
        if min(self.num_validation_windows, self.tuning_steps) < 1 or not self.tuning_rate > 0:
            raise ValueError("num_validation_windows, tuning_steps and tuning_rate must be positive")
        if min(self.kl_weight, self.mi_weight) < 0:
            raise ValueError("kl_weight and mi_weight must not be negative")
        MixtureFrame(1.0, (0.0, 0.0), self.scale_m or 1.0, self.age_scale_steps, self.elapsed_scale_steps)


@dataclass(frozen=True)
class TrainConfig:
    """What to train, on what, for how long.

    preset            "general" (residual of the bank), "paper" (absolute coordinates, the published architecture), "place" (one
                      place learned by heart), or one of the paper's rivals: "vrnn", "grammi_without_mi", "grammi" (which
                      trains the one without first)
    data              folder of MCAP logs with truth; None = synthetic kinematics (general) or the simulator (paper)
    extract           where truth and detections are in the logs of `data`
    seed              of weights, data and noise
    batch_size        windows a step
    num_shards        synthetic shards of about 1250 windows; a shard is made when it is first needed
    num_validation_shards  shards from other scenarios, never trained on
    validate_every, save_every  steps
    threads           of torch; None = as many as there are cores
    network, windows  of the general preset
    paper             of the paper preset
    place             of the place preset; its older name, scene, is still read
    rival             of the rivals
    """

    preset: Literal["general", "paper", "place", "vrnn", "grammi_without_mi", "grammi"] = field(
        default="general", metadata={"older_values": {"scene": "place"}}
    )
    data: Path | None = None
    extract: ExtractConfig = field(default_factory=ExtractConfig)
    seed: int = 0
    batch_size: int = 128
    num_shards: int = 48
    num_validation_shards: int = 1
    validate_every: int = 500
    save_every: int = 250
    threads: int | None = None
    network: ResidualNetworkConfig = field(default_factory=ResidualNetworkConfig)
    windows: SyntheticConfig = field(default_factory=SyntheticConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    paper: AbsoluteTraining = field(default_factory=AbsoluteTraining)
    place: PlaceTraining = field(default_factory=PlaceTraining, metadata={"older_name": "scene"})
    rival: RivalTraining = field(default_factory=RivalTraining)

    def __post_init__(self) -> None:
        if self.batch_size < 2:
            raise ValueError("batch_size must be at least 2")
        counts = (self.num_shards, self.num_validation_shards, self.validate_every, self.save_every, self.optimiser.num_steps)
        if min(counts) < 1:
            raise ValueError(
                "num_shards, num_validation_shards, validate_every, save_every and optimiser.num_steps must be at least 1"
            )
        factor = 2 ** (len(self.network.multipliers) - 1)
        if (self.windows.history_steps + self.windows.horizon_steps) % factor:
            raise ValueError(
                f"windows.history_steps + windows.horizon_steps must be a multiple of {factor}, as network halves them"
            )
