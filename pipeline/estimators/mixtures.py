"""The learned rivals of the paper, VRNN and GrAMMI: mixtures at five horizons, for forecasts only."""

from dataclasses import dataclass, field
from pathlib import Path

from cadence.baselines.grammi import GrammiNetwork, GrammiNetworkConfig
from cadence.baselines.mixture import MixtureFrame, MixtureModel
from cadence.baselines.vrnn import VrnnNetwork, VrnnNetworkConfig
from pipeline.checkpoints import RIVALS, CheckpointInfo, expect_preset, network_config
from pipeline.estimators.loaded import Loaded
from pipeline.estimators.samplings import Samplings
from pipeline.grids import GridConfig
from pipeline.weights import load_network


@dataclass(frozen=True)
class VrnnConfig:
    """What belongs to a VRNN's checkpoint: the network, and what its numbers mean."""

    network: VrnnNetworkConfig = field(default_factory=VrnnNetworkConfig)
    frame: MixtureFrame = field(default_factory=MixtureFrame)


@dataclass(frozen=True)
class GrammiConfig:
    """What belongs to a GrAMMI's checkpoint: the network, and what its numbers mean."""

    network: GrammiNetworkConfig = field(default_factory=GrammiNetworkConfig)
    frame: MixtureFrame = field(default_factory=MixtureFrame)


def load_mixture(weights: Path, samplings: Samplings) -> Loaded:
    """The checkpoint as the stages see it; a known goal is read where it has learned to."""
    model = load_rival(weights, uses_goal=True)
    grid = GridConfig(model.frame.step_s, 1, model.horizons[-1])
    return Loaded(model.name, model, lambda _: grid)


def load_rival(weights: Path, uses_goal: bool = False) -> MixtureModel:
    """The estimator of a rival's checkpoint; `ConfigError` where it is of another preset or does not fit."""
    info = expect_preset(weights, *RIVALS)
    config = rival_config(info, weights)
    network = load_network(weights, lambda: fresh_rival(config))
    return MixtureModel(network, config.frame, info.preset, uses_goal)


def rival_config(info: CheckpointInfo, weights: Path) -> VrnnConfig | GrammiConfig:
    """What the checkpoint says of its network."""
    found: VrnnConfig | GrammiConfig = network_config(VrnnConfig if info.preset == "vrnn" else GrammiConfig, info, weights)
    return found


def fresh_rival(config: VrnnConfig | GrammiConfig) -> VrnnNetwork | GrammiNetwork:
    """An untrained network."""
    if isinstance(config, VrnnConfig):
        return VrnnNetwork(config.network)
    return GrammiNetwork(config.network)
