"""A place learned from recorded tracks, in memory: arrays in, a trained estimator out.

`cadence train` does the same with files: it validates, keeps a curve, and goes on where it was killed.
"""

from collections.abc import Callable

import numpy as np
import torch

from cadence.diffusion.place import PlaceModel
from cadence.diffusion.place_frame import PlaceConfig
from cadence.diffusion.settings import PlaceSampling
from cadence.network.place import PlaceNetwork, PlaceNetworkConfig
from cadence.recordings import Recordings
from cadence.seeds import numpy_stream, torch_stream
from cadence.training.loop import OptimiserConfig, Trainer, untrained
from cadence.training.place_losses import Dropout, diffusion_loss, place_windows

_ROOM = 1.05
"""Map and step limits are those of the recordings with this much room."""


def place_config(recordings: Recordings, network: PlaceNetworkConfig | None = None) -> PlaceConfig:
    """Map, units and limits of a place as the recordings show them.

    Args:
        recordings: all targets that were seen there; ValueError where nothing moves.
        network: sizes and inputs of the network.
    """
    position = recordings.position_m.astype(np.float64)
    is_step = np.ones(len(position), dtype=bool)
    is_step[recordings.offset[:-1]] = False  # from one track to the next nobody went
    step_m = np.diff(position, axis=0, prepend=position[:1])[is_step]
    low, high = position.min(axis=0), position.max(axis=0)
    if not (high > low).any() or not len(step_m):
        raise ValueError("place_config: nothing moves in these recordings")
    middle = 0.5 * (low + high)
    return PlaceConfig(
        network or PlaceNetworkConfig(),
        recordings.step_s,
        (float(middle[0]), float(middle[1])),
        float(0.5 * _ROOM * (high - low).max()),
        float(np.sqrt(np.mean(step_m**2))),
        float(_ROOM * np.linalg.norm(step_m, axis=1).max()),
    )


def train_place(
    recordings: Recordings,
    config: PlaceConfig | None = None,
    optimiser: OptimiserConfig | None = None,
    batch_size: int = 64,
    seed: int = 0,
    on_step: Callable[[int, float], object] | None = None,
) -> PlaceModel:
    """An estimator that forecasts in a place whose tracks it has learned; the same seed gives the same weights.

    Args:
        recordings: what was recorded there.
        config: of the model; by default `place_config` of the recordings.
        optimiser: how long and how fast to learn.
        batch_size: windows a step, every step of every recording equally likely.
        seed: of weights, windows and noise.
        on_step: is called with the number of each step and its loss.
    """
    config = config or place_config(recordings)
    trainer = Trainer(untrained(config.build, seed), optimiser or OptimiserConfig())
    for step in range(trainer.config.num_steps):
        rng = numpy_stream(seed, "windows", step)
        rows = rng.integers(0, len(recordings.position_m), batch_size)
        windows = place_windows(recordings, rows, config, Dropout(), rng)
        generator = torch_stream(seed, "step", step)

        def loss(network: torch.nn.Module) -> torch.Tensor:
            assert isinstance(network, PlaceNetwork)
            return diffusion_loss(network, windows, config, 1.0, generator)  # noqa: B023 - is called at once

        value = trainer.advance(loss)
        if on_step is not None:
            on_step(step, value)
    learned = trainer.ema.network
    assert isinstance(learned, PlaceNetwork)
    return PlaceModel(learned.eval(), config, PlaceSampling())
