"""Training of scene networks: windows out of recordings, the diffusion loss, and the energy score of a few-step sampler."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cadence.diffusion.sampler import even_angles, sample_ddim
from cadence.diffusion.scene_frame import SceneConfig, recorded_track, scene_inputs, to_pieces
from cadence.diffusion.schedule import MAX_ANGLE, clean_from
from cadence.network.scene import Pieces, SceneInputs, SceneNetwork
from cadence.types import Context
from cadence.worlds.recordings import NUM_STEPS, Recordings, cut_windows

_LEAST_ANGLE = 0.01
_LOCAL_SCALE = 0.05
"""Brings the energy score of single pieces near that of positions over the map's side."""


@dataclass(frozen=True)
class Dropout:
    """Which windows are told less, so that one network serves with and without; shares of the windows.

    known_start  the target's first position counts as a detection
    known_goal   the goal that the trackers know of is told
    trackers     the trackers' positions are told
    """

    known_start: float = 0.75
    known_goal: float = 0.7
    trackers: float = 0.8


@dataclass(frozen=True, eq=False)
class SceneWindows:
    """Training windows: what is known of them, and the true track as pieces [R, P, 2]."""

    inputs: SceneInputs
    clean: Tensor

    def __len__(self) -> int:
        return len(self.clean)

    def __getitem__(self, pick: slice | Tensor) -> "SceneWindows":
        """A selection of windows."""
        return SceneWindows(self.inputs[pick], self.clean[pick])


def scene_windows(
    recordings: Recordings, rows: NDArray[np.int64], config: SceneConfig, told: Dropout, rng: np.random.Generator
) -> SceneWindows:
    """Windows whose origins are the given rows of the recordings; those without any detection are left out."""
    episode = np.searchsorted(recordings.offset, rows, side="right") - 1
    step = rows - recordings.offset[episode]
    has_start, has_goal, has_trackers = (
        rng.random(len(rows)) < share for share in (told.known_start, told.known_goal, told.trackers)
    )
    cut = cut_windows(recordings, episode, step, known_start=has_start)
    context = cut.context
    assert context.known_goal_m is not None and context.tracker_m is not None
    context = Context(
        context.datum_m,
        context.elapsed_s,
        context.known_goal_m.masked_fill(torch.from_numpy(~has_goal)[:, None, None], torch.nan),
        context.tracker_m.masked_fill(torch.from_numpy(~has_trackers)[:, None, None, None], torch.nan),
    )
    active = cut.windows.is_active[:, 0]
    inputs = scene_inputs(cut.windows[active], context[active], config)
    keep = active.numpy()
    track_m = recorded_track(recordings, rows[keep], episode[keep], inputs.pieces)
    return SceneWindows(inputs, to_pieces(track_m, inputs.pieces, config))


def diffusion_loss(
    network: SceneNetwork, windows: SceneWindows, config: SceneConfig, path_weight: float, generator: torch.Generator
) -> Tensor:
    """Mean square error of the velocity: of every piece, and `path_weight` times that of the positions it adds up to.

    A displacement's error is carried on to all later positions, and that of the stretch up to now, whose pieces are long
    when the detection is old, counts as what it is. Both are quadratic forms of the same error: the best answer is the same.
    """
    angle = _LEAST_ANGLE + (MAX_ANGLE - 2 * _LEAST_ANGLE) * torch.rand(len(windows), generator=generator)
    noise = torch.randn(windows.clean.shape, generator=generator)
    cos, sin = torch.cos(angle)[:, None, None], torch.sin(angle)[:, None, None]
    pieces = windows.inputs.pieces
    answer = network(cos * windows.clean + sin * noise, angle, pieces, network.encode(windows.inputs)).float()
    error = answer - (cos * noise - sin * windows.clean)
    is_real = (pieces.span > 0).to(error.dtype)[..., None]
    share = pieces.span / pieces.span.sum(dim=1, keepdim=True)
    carried = (error * share[..., None]).cumsum(dim=1)[:, config.num_gap - 1 :]
    local = (error.square() * is_real).sum() / (2.0 * is_real.sum())
    loss: Tensor = local + path_weight * config.num_pieces * carried.square().mean()
    return loss


def few_step_sample(network: SceneNetwork, pieces: Pieces, code: Tensor, noise: Tensor, num_steps: int) -> Tensor:
    """Clean pieces [R, P, 2] from standard normal `noise` in `num_steps` evaluations (DDIM); gradients pass through."""

    def denoise(noisy: Tensor, angle: float) -> Tensor:
        answer = network(noisy, torch.full((len(noisy),), angle), pieces, code).float()
        return clean_from("v", answer, noisy, torch.tensor(angle))

    return sample_ddim(denoise, noise, even_angles(num_steps))


def energy_loss(
    network: SceneNetwork,
    windows: SceneWindows,
    config: SceneConfig,
    num_samples: int,
    weights: tuple[float, float],
    generator: torch.Generator,
) -> Tensor:
    """Energy score (Gneiting, Raftery, 2007) of `num_samples` tracks of the few-step sampler a window, over the map's side.

    The score of the position at every knot from now on, plus `weights` times that of the whole track as one vector and that
    of every piece alone: proper scores all of them, so the best that a sampler can do is the true distribution.
    """
    inputs, clean = windows.inputs, windows.clean
    noise = torch.randn(len(clean) * num_samples, *clean.shape[1:], generator=generator)
    code = network.encode(inputs).repeat_interleave(num_samples, dim=0)
    found = few_step_sample(network, inputs.pieces.repeated(num_samples), code, noise, config.few_steps)
    found = found.reshape(len(clean), num_samples, *clean.shape[1:])
    span = 0.5 * inputs.pieces.span[..., None]  # places count half the map's side
    track, truth = (found * span[:, None]).cumsum(dim=2), (clean * span).cumsum(dim=1)
    knots = slice(config.num_gap - 1, config.num_gap - 1 + NUM_STEPS // config.stride + 1)
    at_knots = _energy_score(track[:, :, knots], truth[:, knots]).mean()
    joint = _energy_score(track.flatten(2)[:, :, None], truth.flatten(1)[:, None]).mean() / clean.shape[1] ** 0.5
    is_real = (inputs.pieces.span > 0).float()
    local = (_energy_score(found, clean) * is_real).sum() / is_real.sum()
    loss: Tensor = at_knots + weights[0] * joint + weights[1] * _LOCAL_SCALE * local
    return loss


def _energy_score(found: Tensor, truth: Tensor) -> Tensor:
    """Unbiased energy score [R, H] of samples [R, K, H, D] for truth [R, H, D]; its gradient is finite everywhere."""
    first, second = torch.triu_indices(found.shape[1], found.shape[1], 1)
    error = _length(found - truth[:, None]).mean(dim=1)
    return error - 0.5 * _length(found[:, first] - found[:, second]).mean(dim=1)


def _length(vector: Tensor) -> Tensor:
    length: Tensor = torch.sqrt(vector.square().sum(dim=-1) + 1e-8)
    return length
