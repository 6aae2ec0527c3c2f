"""What tracks of a whole mission must obey, kept exactly: obstacles, a speed that is stated and one that is plausible.

A stretch that breaks a limit is drawn anew while tracks are drawn (`draw`), which changes nothing but what is known: hypotheses
that cannot be are left out. What hardly ever keeps the limits is mended: slowed down between the steps that detections
hold, and led around obstacles, as windows are (`cadence.constraints.limits`). What cannot be mended is left out, and a track
that keeps the limits counts twice.
"""

import dataclasses
import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.constraints.limits import KeepOut, within_limits
from cadence.constraints.obstacles import Obstacles
from cadence.resampling import systematic

_PINNED_SHARE, _HELD_SHARE = 0.05, 0.5
"""As in windows: steps that are known to within so many step lengths stay where they are."""
_MOST = 0.5
"""Where fewer tracks can keep it, a plausible speed is no limit."""
_MOST_SIGMAS = 3.0
"""Where a track is known, mending moves it by no more than so many deviations."""
_LEAST_PIECE = 32
"""Tracks are slowed down in pieces of so many steps or more, between steps that stay where they are."""


@dataclass(frozen=True, eq=False)
class MissionLimits:
    """Limits of all tracks of a mission.

    obstacles      may be none; margin_m is kept from them where they are led around
    datum_m        [2] of the tracks' positions in the obstacles' frame
    max_speed_mps  stated, None for no limit
    plausible_speed_mps  what the detections let one believe; kept where most tracks can keep it
    length_m       one usual step length
    """

    obstacles: Obstacles
    margin_m: float
    datum_m: Tensor
    max_speed_mps: float | None
    plausible_speed_mps: float | None
    length_m: float

    @property
    def is_limited(self) -> bool:
        """Whether there is anything to obey."""
        return self.obstacles.count > 0 or self.speed_mps is not None

    @property
    def speed_mps(self) -> float | None:
        """The lower of the two speeds."""
        limits = [speed for speed in (self.max_speed_mps, self.plausible_speed_mps) if speed is not None]
        return min(limits) if limits else None

    def keeps(self, position_m: Tensor, is_asked: Tensor, time_s: Tensor) -> Tensor:
        """Which tracks [N, L, 2] keep all limits where they are asked for [N, L]; times [L]."""
        is_kept = torch.ones(len(position_m), dtype=torch.bool)
        is_step = is_asked[:, 1:] & is_asked[:, :-1]
        if self.speed_mps is not None and len(time_s) > 1:
            is_kept &= ~(_too_long(position_m, self.speed_mps * time_s.diff()) & is_step).any(1)
        if self.obstacles.count:
            is_kept &= ~(states_in_collision(position_m, self.obstacles, offset_m=self.datum_m) & is_asked).any(1)
            is_kept &= ~(segments_in_collision(position_m, self.obstacles, offset_m=self.datum_m) & is_step).any(1)
        return is_kept

    def mended(self, position_m: Tensor, time_s: Tensor, seed: int) -> tuple[Tensor, Tensor]:
        """Tracks [K, T, 2] of one agent within the limits, and which of them took the place of others [K].

        Where no track keeps what is stated, all are left as they are. NaN, the same steps of all tracks, stays.
        """
        is_replaced = torch.zeros(len(position_m), dtype=torch.bool)
        is_there = ~torch.isnan(position_m[0, :, 0])
        if not self.is_limited or not bool(is_there.any()):
            return position_m, is_replaced
        way_m, time_s = position_m[:, is_there], time_s[is_there]
        spread_m = way_m.double().var(0, correction=0).mean(-1).sqrt()
        is_held = spread_m <= _HELD_SHARE * self.length_m
        for share in (_HELD_SHARE, _PINNED_SHARE):
            wrong = (~self._keeps_all(way_m, time_s)).nonzero()[:, 0]
            if len(wrong):
                led_m = self._led(way_m[wrong], time_s, spread_m, share * self.length_m)
                # what stays at first may move a little then, but what detections say is not given up for a speed
                room_m = _MOST_SIGMAS * spread_m + _PINNED_SHARE * self.length_m
                is_near = ((led_m - way_m[wrong]).norm(dim=-1) <= room_m)[:, is_held].all(1) | (share == _HELD_SHARE)
                way_m = way_m.clone()
                way_m[wrong[is_near]] = led_m[is_near]
        way_m, is_replaced = self._replaced(way_m, time_s, seed)
        out = position_m.clone()
        out[:, is_there] = way_m
        return out, is_replaced

    def _keeps_all(self, way_m: Tensor, time_s: Tensor) -> Tensor:
        return self.keeps(way_m, torch.ones(way_m.shape[:2], dtype=torch.bool), time_s)

    def _led(self, way_m: Tensor, time_s: Tensor, spread_m: Tensor, hold_m: float) -> Tensor:
        """Tracks [N, T, 2] slowed down and led around obstacles, piece by piece between steps that are known to `hold_m`."""
        is_held = (spread_m <= hold_m) | (spread_m == spread_m.amin())
        is_pinned = spread_m <= _PINNED_SHARE * self.length_m
        keep_out = KeepOut(self.obstacles, self.margin_m, self.datum_m.expand(1, 1, 1, 2))
        longest_m = None if self.speed_mps is None else self.speed_mps * time_s.diff()
        out = way_m.clone()
        for begin, end in _pieces(is_held):
            part = slice(begin, end + 1)
            is_wrong = ~self._keeps_all(out[:, part], time_s[part])
            if not bool(is_wrong.any()):
                continue
            held, pinned = is_held[part].clone(), is_pinned[part].clone()
            for mask in (held, pinned):  # neighbouring pieces share the steps at their ends
                mask[0] |= begin > 0
                mask[-1] |= end + 1 < len(time_s)
            moved, _ = within_limits(
                out[is_wrong, part][None],
                keep_out,
                pinned.expand(1, int(is_wrong.sum()), -1),
                None if longest_m is None else longest_m[begin:end],
                held.expand(1, int(is_wrong.sum()), -1),
            )
            out[is_wrong, part] = moved[0]
        return out

    def _replaced(self, way_m: Tensor, time_s: Tensor, seed: int) -> tuple[Tensor, Tensor]:
        """Tracks that break a limit drawn again from those that keep it, and which these are [K].

        What is only implausible is kept where most tracks are: what the detections ask for, nobody can forbid.
        """
        is_kept = self._keeps_all(way_m, time_s)
        if float(is_kept.double().mean()) < _MOST:
            stated = dataclasses.replace(self, plausible_speed_mps=None)
            is_kept = stated.keeps(way_m, torch.ones(way_m.shape[:2], dtype=torch.bool), time_s)
        lost = (~is_kept).nonzero()[:, 0]
        if not bool(is_kept.any()) or not len(lost):
            return way_m, torch.zeros_like(is_kept)
        generator = torch.Generator().manual_seed(seed)
        uniform = torch.rand(1, generator=generator, dtype=torch.float64).item()
        pick = torch.from_numpy(systematic(is_kept.double().numpy(), len(lost), uniform))
        out = way_m.clone()
        out[lost] = way_m[pick[torch.randperm(len(lost), generator=generator)]]
        return out, ~is_kept


def _too_long(position_m: Tensor, longest_m: Tensor) -> Tensor:
    """Steps [N, L - 1] of tracks [N, L, 2] that are longer than `longest_m` [L - 1]."""
    length: Tensor = position_m.diff(dim=1).norm(dim=-1)
    return length > longest_m * (1.0 + 1e-6)


def _pieces(is_held: Tensor) -> list[tuple[int, int]]:
    """First and last step of pieces that begin and end with steps that stay, and share these; all steps [T] in order."""
    corners = [0]
    for step in is_held.nonzero()[:, 0].tolist():
        if step - corners[-1] >= _LEAST_PIECE:
            corners.append(step)
    if corners[-1] < len(is_held) - 1:
        corners.append(len(is_held) - 1)
    return list(itertools.pairwise(corners))
