"""How a place model states windows and tracks: what its network is told, and a track as displacements from the last detection.

The stretch from the last detection to now is cut into a fixed number of equal pieces, however long ago the detection was; the
future into pieces of equal length. So a track begins exactly at the detection, and a piece of length one is one at unit speed.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from cadence.arrays import Int64s
from cadence.network.place import Pieces, PlaceInputs, PlaceNetwork, PlaceNetworkConfig, octaves
from cadence.recordings import NUM_STEPS, Recordings
from cadence.types import Context, Detections, WindowBatch

_NUM_OCTAVES = 5
_TRACKER_LAGS = (0, 4, 8, 16, 32, 63)
"""Steps before now at which a tracker's position is told."""
_NUM_RECENT = 8
"""The last detections that are always read; the others are taken evenly from all that went before."""

NUM_ROW = 7 + 4 * _NUM_OCTAVES
NUM_SUMMARY = 15 + 8 * _NUM_OCTAVES
NUM_TRACKER = 4 * len(_TRACKER_LAGS) + 3


@dataclass(frozen=True)
class PlaceConfig:
    """What belongs to a checkpoint: the network, and what its numbers mean.

    network      its sizes and inputs
    step_s       seconds between steps
    centre_m, scale_m  of the map: (place - centre) / scale lies within -1 ... 1
    edge_m       lowest x, y and highest x, y of a map that ends somewhere, which no track leaves; None where no edge is known
    unit_step_m  a coordinate's change in a step that counts as one; about its root mean square
    max_step_m   no step is longer
    num_gap, num_future  pieces from the last detection to now, and from now on
    stride       steps of a piece of the future
    few_steps    evaluations of the few-step sampler that the weights were tuned for; 0: they were not
    shared_gap_steps  0: it is known whose a detection is, and an agent's track begins at its own last one. Else nobody knows,
                 as in the paper's unknown origin: every agent is told all detections, and every track leads from the last of
                 them to where its agent is now within so many steps
    """

    network: PlaceNetworkConfig = field(default_factory=PlaceNetworkConfig)
    step_s: float = 60.0
    centre_m: tuple[float, float] = (25494.0, 25494.0)
    scale_m: float = 25494.0
    unit_step_m: float = 110.0
    max_step_m: float = 170.0
    num_gap: int = 8
    num_future: int = 32
    stride: int = 4
    few_steps: int = 0
    shared_gap_steps: int = 0
    edge_m: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.num_future * self.stride < NUM_STEPS or min(self.num_gap, self.stride) < 1:
            raise ValueError(f"num_future * stride must reach {NUM_STEPS} steps, num_gap be at least 1")
        if min(self.step_s, self.scale_m, self.unit_step_m, self.max_step_m) <= 0:
            raise ValueError("step_s, scale_m, unit_step_m and max_step_m must be positive")
        if self.edge_m is not None and not (self.edge_m[0] < self.edge_m[2] and self.edge_m[1] < self.edge_m[3]):
            raise ValueError("edge_m must be the lowest x and y of the map, then the highest")
        if min(self.few_steps, self.shared_gap_steps) < 0:
            raise ValueError("few_steps and shared_gap_steps must not be negative")
        if self.num_pieces % 2 ** (len(self.network.multipliers) - 1):
            raise ValueError("num_gap + num_future must be a multiple of 2 for every level of the network but one")

    @property
    def num_pieces(self) -> int:
        """Pieces of a track."""
        return self.num_gap + self.num_future

    def build(self) -> PlaceNetwork:
        """The untrained network."""
        return PlaceNetwork(self.network, NUM_ROW, NUM_SUMMARY, NUM_TRACKER)


def place_inputs(windows: WindowBatch, config: PlaceConfig) -> PlaceInputs:
    """What the network is told of windows with one agent each, all with at least one detection [R = B]."""
    context = windows.required_context("place_inputs")
    if windows.num_agents != 1 or not bool(windows.is_active.all()):
        raise ValueError("place_inputs: windows of one agent with at least one detection each are needed")
    seen = _Seen(windows.detections, context, config)
    goal, is_goal = _goal(context, config, seen.last)
    elapsed = seen.age[:, :1] if context.elapsed_s is None else (context.elapsed_s.float() / config.step_s)[:, None]
    trackers, is_tracker = _trackers(context, config, seen.last)
    rows, is_observed = seen.rows(config.network.max_detections)
    last = seen.told("absolute", octaves(seen.last, _NUM_OCTAVES))
    summary = [*seen.summary(elapsed), is_goal, goal, last, octaves(goal, _NUM_OCTAVES) * is_goal]
    gap = torch.full_like(seen.last_age, config.shared_gap_steps) if config.shared_gap_steps else seen.last_age
    pieces = _pieces(seen.last, gap, config)
    return PlaceInputs(rows, is_observed, torch.cat(summary, dim=-1), trackers, is_tracker, pieces)


class _Seen:
    """The detections of R windows in the network's units: age [R, N] in steps, place [R, N, 2], count [R]."""

    def __init__(self, detections: Detections, context: Context, config: PlaceConfig) -> None:
        centre = torch.tensor(config.centre_m, dtype=torch.float64)
        self.unit = config.unit_step_m / config.scale_m
        self.places = config.network.places
        self.age = (-detections.time_s[:, 0] / config.step_s).float()
        self.place = ((detections.position_m[:, 0] + context.datum_m[:, None] - centre) / config.scale_m).float()
        self.count = detections.is_observed[:, 0].sum(dim=1)
        self.last_age = self.age.gather(1, (self.count - 1)[:, None])
        self.last = self._place_at((self.count - 1)[:, None])[:, 0]

    def told(self, kind: str, values: Tensor) -> Tensor:
        """Absolute or relative `values`, or zeros where places are not told in this way."""
        return values if self.places in ("both", kind) else torch.zeros_like(values)

    def _place_at(self, index: Tensor) -> Tensor:
        return self.place.gather(1, index[..., None].expand(-1, -1, 2))

    def rows(self, keep: int) -> tuple[Tensor, Tensor]:
        """Features [R, keep, F] of the detections that are read, and which of them exist [R, keep]."""
        index, is_observed = _thinned(self.count, keep)
        age, place = self.age.gather(1, index), self._place_at(index)
        columns = [
            torch.log1p(age)[..., None] / 3.0,
            age[..., None] / 200.0,
            self.told("absolute", place),
            self.told("relative", (4.0 * (place - self.last[:, None])).clamp(-4.0, 4.0)),
            torch.log1p(age - self.last_age)[..., None] / 3.0,
            self.told("absolute", octaves(place, _NUM_OCTAVES)),
        ]
        return torch.cat(columns, dim=-1), is_observed

    def summary(self, elapsed: Tensor) -> list[Tensor]:
        """Columns [R, *] about all detections: how old, where, how fast, how many."""
        before = (self.count - 2).clamp_min(0)[:, None]
        since = (self.age.gather(1, before) - self.last_age).clamp_min(1.0)
        velocity = (self.last - self._place_at(before)[:, 0]) / self.unit / since
        count = self.count.float()[:, None]
        return [
            torch.log1p(self.last_age) / 3.0,
            self.last_age / 100.0,
            elapsed / 300.0,
            torch.log1p(elapsed) / 4.0,
            self.told("absolute", self.last),
            self.told("relative", velocity.clamp(-2.0, 2.0)),
            torch.log1p(since) / 3.0,
            torch.log1p(count) / 3.0,
            count / (elapsed + 1.0),
            self.age[:, :1] / (elapsed + 1.0),
        ]


def _thinned(count: Tensor, keep: int) -> tuple[Tensor, Tensor]:
    """Which detections are read [R, keep], and which of these exist: all, or the last few and an even choice of the others."""
    place = torch.arange(keep)
    num_old = max(keep - _NUM_RECENT, 1)
    share = place[:num_old] / max(num_old - 1, 1)
    early = ((count[:, None] - (keep - num_old) - 1).clamp_min(0) * share).round().long()
    late = count[:, None] - keep + place[num_old:]
    index = torch.where(count[:, None] > keep, torch.cat([early, late], dim=1), place)
    return index.minimum(count[:, None] - 1), index < count[:, None]


def _goal(context: Context, config: PlaceConfig, last: Tensor) -> tuple[Tensor, Tensor]:
    """The known goal [R, 2], zero where there is none, and whether there is one [R, 1]; relative ones about `last` [R, 2]."""
    size = len(context.datum_m)
    if context.known_goal_m is None or not config.network.known_goal:
        return torch.zeros(size, 2), torch.zeros(size, 1)
    place = (context.known_goal_m[:, 0] - torch.tensor(config.centre_m)) / config.scale_m
    if config.network.places == "relative":
        place = place - last
    is_goal = place.isfinite().all(dim=-1, keepdim=True)
    return torch.where(is_goal, place, 0.0).float(), is_goal.float()


def _trackers(context: Context, config: PlaceConfig, last: Tensor) -> tuple[Tensor, Tensor]:
    """Where the trackers were, about the last detection and on the map [R, M, G], and which are there [R, M]."""
    if context.tracker_m is None or not config.network.trackers or not context.tracker_m.shape[2]:
        return torch.zeros(len(last), 1, NUM_TRACKER), torch.zeros(len(last), 1)
    num_steps = context.tracker_m.shape[1]
    at = [max(num_steps - 1 - lag, 0) for lag in _TRACKER_LAGS]
    place = ((context.tracker_m[:, at] - torch.tensor(config.centre_m)) / config.scale_m).float().transpose(1, 2)
    is_there = place.isfinite().all(dim=-1, keepdim=True)
    offset = torch.where(is_there, place - last[:, None, None], 0.0)
    is_told = is_there[:, :, 0] & (config.network.places != "relative")
    now = torch.where(is_told, place[:, :, 0], 0.0)
    speed = (offset[:, :, 0] - offset[:, :, 1]).norm(dim=-1, keepdim=True) * config.scale_m / config.unit_step_m
    features = [offset.flatten(2), torch.tanh(8.0 * offset).flatten(2), now, speed / (8.0 * _TRACKER_LAGS[1])]
    return torch.cat(features, dim=-1), is_there[:, :, 0, 0].float()


def _pieces(last: Tensor, last_age: Tensor, config: PlaceConfig) -> Pieces:
    gap = (last_age / config.num_gap).expand(-1, config.num_gap)
    future = torch.arange(config.num_future, dtype=last.dtype).expand(len(last), -1) * config.stride
    start = torch.cat([gap * torch.arange(config.num_gap) - last_age, future], dim=1)
    duration = torch.cat([gap, torch.full_like(future, config.stride)], dim=1)
    return Pieces(last, start, duration, duration * (config.unit_step_m / config.scale_m))


def recorded_track(recordings: Recordings, row: Int64s, episode: Int64s, pieces: Pieces) -> Tensor:
    """True positions [R, P + 1, 2] in metres at the ends of all pieces, for windows whose origins are the given rows [R].

    Straight between steps; after its episode's end (`episode` [R]) the target stays.
    """
    ends = torch.cat([pieces.start[:, :1], pieces.start + pieces.duration], dim=1).double().numpy()
    first, last = recordings.offset[episode][:, None], recordings.offset[episode + 1][:, None] - 1
    at = np.clip(row[:, None] + ends, first, last)
    before = np.floor(at).astype(np.int64)
    share = (at - before)[..., None]
    place = recordings.position_m
    return torch.from_numpy(place[before] * (1.0 - share) + place[np.minimum(before + 1, last)] * share)


def to_pieces(track_m: Tensor, pieces: Pieces, config: PlaceConfig) -> Tensor:
    """Tracks [R, ..., P + 1, 2] in metres through the ends of all pieces as displacements [R, ..., P, 2] at unit speed."""
    span_m = _over(pieces.span * config.scale_m, track_m)
    return torch.where(span_m > 0, track_m.diff(dim=-2) / span_m.clamp_min(1e-6), 0.0).float()


def to_track(displacement: Tensor, pieces: Pieces, config: PlaceConfig) -> Tensor:
    """Displacements [R, ..., P, 2] as tracks [R, ..., P + 1, 2] in metres from the last detection, which comes first."""
    ends = (displacement * _over(pieces.span * config.scale_m, displacement)).cumsum(dim=-2)
    return torch.nn.functional.pad(ends, (0, 0, 1, 0))


def future_of(track: Tensor, config: PlaceConfig) -> Tensor:
    """Positions [..., T, 2] at now and the steps after it, of tracks [..., P + 1, 2]; straight within a piece."""
    ends = track[..., config.num_gap :, :]
    at = torch.arange(NUM_STEPS) / config.stride
    before = at.floor().long()
    share = (at - before).to(track.dtype)[:, None]
    return ends[..., before, :] * (1.0 - share) + ends[..., (before + 1).clamp(max=config.num_future), :] * share


def past_of(track: Tensor, pieces: Pieces, config: PlaceConfig, num_steps: int) -> Tensor:
    """Positions [R, K, num_steps, 2] at the steps before now, of tracks [R, K, P + 1, 2]; NaN before the last detection."""
    at = torch.arange(-num_steps, 0, dtype=track.dtype) - pieces.start[:, :1].to(track.dtype)  # [R, steps] since the detection
    share = at / pieces.duration[:, :1].to(track.dtype).clamp_min(1e-9)
    before = share.floor().long().clamp(0, config.num_gap - 1)
    pick = before[:, None, :, None].expand(-1, track.shape[1], -1, 2)
    near, far = track.gather(2, pick), track.gather(2, pick + 1)
    found = near + (share - before)[:, None, :, None] * (far - near)
    return torch.where((at >= 0)[:, None, :, None], found, torch.nan)


def _over(span: Tensor, like: Tensor) -> Tensor:
    """Spans [R, P] to stand beside [R, ..., P, 2]."""
    return span.reshape(len(span), *(1,) * (like.ndim - 3), span.shape[-1], 1).to(like.dtype)
