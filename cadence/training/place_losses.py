"""Training of place networks: windows out of recordings, the diffusion loss, and the energy score of a few-step sampler."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cadence.arrays import Int64s
from cadence.diffusion.place_frame import PlaceConfig, place_inputs, recorded_track, to_pieces
from cadence.diffusion.place_team import agent_rows, shared_detections
from cadence.diffusion.sampler import even_angles, sample_ddim
from cadence.network.attention import Team
from cadence.network.place import Pieces, PlaceInputs, PlaceNetwork
from cadence.recordings import NUM_STEPS, Recordings, cut_windows
from cadence.schedule import MAX_ANGLE, clean_from

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
class PlaceWindows:
    """Training windows, an agent a row: what is known of them, and the true track as pieces [R, P, 2].

    is_real [R] bool; other rows stand for absent agents. team: which rows see each other; None: none do.
    """

    inputs: PlaceInputs
    clean: Tensor
    is_real: Tensor
    team: Team | None = None

    def __len__(self) -> int:
        return len(self.clean)

    def parts(self, num_rows: int) -> Iterator["PlaceWindows"]:
        """The windows in parts of about so many rows, the agents of a window together."""
        size = 1 if self.team is None else self.team.num_agents
        num = max(1, num_rows // size)
        for begin in range(0, len(self) // size, num):
            pick = slice(begin * size, (begin + num) * size)
            team = self.team and self.team[slice(begin, begin + num)]
            yield PlaceWindows(self.inputs[pick], self.clean[pick], self.is_real[pick], team)


def place_windows(
    recordings: Recordings, rows: Int64s, config: PlaceConfig, told: Dropout, rng: np.random.Generator
) -> PlaceWindows:
    """Windows whose origins are the given rows of the recordings; those without any detection are left out.

    A row of a track among several means the whole episode's window at that step: all of its agents.
    """
    track = np.searchsorted(recordings.offset, rows, side="right") - 1
    step = rows - recordings.offset[track]
    episode = track // recordings.num_agents
    has_start, has_goal, has_trackers = (
        rng.random(len(rows)) < share for share in (told.known_start, told.known_goal, told.trackers)
    )
    cut = cut_windows(recordings, episode, step, known_start=has_start)
    context = cut.context
    assert context.known_goal_m is not None and context.tracker_m is not None
    told_context = replace(
        context,
        known_goal_m=context.known_goal_m.masked_fill(torch.from_numpy(~has_goal)[:, None, None], torch.nan),
        tracker_m=context.tracker_m.masked_fill(torch.from_numpy(~has_trackers)[:, None, None, None], torch.nan),
    )
    told_windows = (shared_detections(cut.windows) if config.shared_gap_steps else cut.windows).with_context(told_context)
    found = agent_rows(told_windows, config)
    inputs = place_inputs(found.windows, config)
    track = episode[found.window] * recordings.num_agents + found.agent.numpy()
    now = recordings.offset[track] + step[found.window]
    track_m = recorded_track(recordings, now, track, inputs.pieces)
    if config.shared_gap_steps:
        track_m = _led_from_last(track_m, inputs.pieces, config)
    return PlaceWindows(inputs, to_pieces(track_m, inputs.pieces, config), found.is_real, found.team)


def _led_from_last(track_m: Tensor, pieces: Pieces, config: PlaceConfig) -> Tensor:
    """Tracks [R, P + 1, 2] whose way to now is the straight one from the last detection of anybody."""
    last_m = pieces.last.double() * config.scale_m + torch.tensor(config.centre_m, dtype=torch.float64)
    share = torch.linspace(0.0, 1.0, config.num_gap + 1, dtype=torch.float64)[:, None]
    now_m = track_m[:, config.num_gap : config.num_gap + 1]
    return torch.cat([last_m[:, None] + share * (now_m - last_m[:, None]), track_m[:, config.num_gap + 1 :]], dim=1)


def diffusion_loss(
    network: PlaceNetwork, windows: PlaceWindows, config: PlaceConfig, path_weight: float, generator: torch.Generator
) -> Tensor:
    """Mean square error of the velocity: of every piece, and `path_weight` times that of the positions it adds up to.

    A displacement's error is carried on to all later positions, and that of the stretch up to now, whose pieces are long
    when the detection is old, counts as what it is. Both are quadratic forms of the same error: the best answer is the same.
    """
    size = 1 if windows.team is None else windows.team.num_agents
    level = torch.rand(len(windows) // size, generator=generator).repeat_interleave(size)  # one for all agents of a window
    angle = _LEAST_ANGLE + (MAX_ANGLE - 2 * _LEAST_ANGLE) * level
    noise = torch.randn(windows.clean.shape, generator=generator)
    cos, sin = torch.cos(angle)[:, None, None], torch.sin(angle)[:, None, None]
    pieces = windows.inputs.pieces
    noisy = cos * windows.clean + sin * noise
    answer = network(noisy, angle, pieces, network.encode(windows.inputs), windows.team).float()
    error = (answer - (cos * noise - sin * windows.clean)) * windows.is_real[:, None, None]
    is_real = ((pieces.span > 0) & windows.is_real[:, None]).to(error.dtype)[..., None]
    share = pieces.span / pieces.span.sum(dim=1, keepdim=True)
    carried = (error * share[..., None]).cumsum(dim=1)[:, config.num_gap - 1 :]
    local = (error.square() * is_real).sum() / (2.0 * is_real.sum())
    present = windows.is_real.sum() / len(windows)
    loss: Tensor = local + path_weight * config.num_pieces * carried.square().mean() / present
    return loss


def few_step_sample(
    network: PlaceNetwork, pieces: Pieces, code: Tensor, noise: Tensor, num_steps: int, team: Team | None = None
) -> Tensor:
    """Clean pieces [R, P, 2] from standard normal `noise` in `num_steps` evaluations (DDIM); gradients pass through."""

    def denoise(noisy: Tensor, angle: float) -> Tensor:
        answer = network(noisy, torch.full((len(noisy),), angle), pieces, code, team).float()
        return clean_from("v", answer, noisy, torch.tensor(angle))

    return sample_ddim(denoise, noise, even_angles(num_steps))


def energy_loss(
    network: PlaceNetwork,
    windows: PlaceWindows,
    config: PlaceConfig,
    num_samples: int,
    weights: tuple[float, float],
    generator: torch.Generator,
) -> Tensor:
    """Energy score (Gneiting, Raftery, 2007) of `num_samples` tracks of the few-step sampler a window, over the map's side.

    The score of the position at every knot from now on, plus `weights` times that of the whole track as one vector and that
    of every piece alone: proper scores all of them, so the best that a sampler can do is the true distribution. The whole
    track is that of all agents of a window, where they see each other.
    """
    inputs, clean = windows.inputs, windows.clean
    noise = torch.randn(len(clean) * num_samples, *clean.shape[1:], generator=generator)
    code = network.encode(inputs).repeat_interleave(num_samples, dim=0)
    team = windows.team and windows.team.repeated(num_samples)
    found = few_step_sample(network, inputs.pieces.repeated(num_samples), code, noise, config.few_steps, team)
    found = found.reshape(len(clean), num_samples, *clean.shape[1:])
    span = 0.5 * inputs.pieces.span[..., None]  # places count half the map's side
    track, truth = (found * span[:, None]).cumsum(dim=2), (clean * span).cumsum(dim=1)
    knots = slice(config.num_gap - 1, config.num_gap - 1 + NUM_STEPS // config.stride + 1)
    present = windows.is_real.float()
    at_knots = (_energy_score(track[:, :, knots], truth[:, knots]).mean(dim=1) * present).sum() / present.sum()
    size = 1 if windows.team is None else windows.team.num_agents
    by_window = (track * present[:, None, None, None]).reshape(-1, size, *track.shape[1:])
    whole = by_window.transpose(1, 2).flatten(2)  # [B, K, A * P * 2]
    true_whole = (truth * present[:, None, None]).reshape(len(whole), -1)
    joint = _energy_score(whole[:, :, None], true_whole[:, None]).mean() / (size * clean.shape[1]) ** 0.5
    is_real = (inputs.pieces.span > 0).float() * present[:, None]
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
