"""What a log's own detections let one believe of how fast its targets are."""

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from cadence.types import Detections

_DOUBTS = 2.0, 1.0
"""Of many speeds the greatest is one that noise favoured: pairs are compared with so many standard deviations taken off, and
the fastest counts with so many."""
_SPARED = 0.001
"""So few of the fastest pairs may still be false detections."""
_AWAY = 2.0
"""A detection so many times as far from both its neighbours as these are from each other is likelier false than a dash there
and back; a turn that it hides is seen elsewhere."""

_LEAST_GAPS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_MAX_STEPS = 20.0
"""Pairs are so many steps apart at least: near ones tell of moments, far ones where noise rules those. Over longer gaps the
straight way says little of the speed."""

_LEAST, _MOST = 1.0, 1.25
"""Of 24 patrols and 23 recordings of aircraft, ships and a drone, seen 5 to 30 % of the time, the speed that one true step of
the grid in a thousand exceeds is .92 to 1.14 times the fastest that was seen (eight in ten), half of them .98 to 1.07. Up to
1.12 the regions of twelve other patrols held 5 to 7 % less of the truth, up to 1.25 as much as without a limit."""

_PLACES = math.sqrt(2.0) - 1.0
"""Of places that have nothing to do with those by which a pool shares hypotheses out."""


@dataclass(frozen=True)
class TopSpeed:
    """What is known of the speed that the targets of a log do not exceed over a step of its grid.

    seen_mps  the fastest that was seen
    """

    seen_mps: float

    @property
    def limit_mps(self) -> float:
        """The greatest one that is believed."""
        return _MOST * self.seen_mps

    def spread(self, num_hypotheses: int) -> Tensor:
        """A top speed for each hypothesis [K], as they are believed; any first ones of them are spread alike."""
        place = (0.5 + _PLACES * torch.arange(num_hypotheses, dtype=torch.float64)) % 1.0
        return self.seen_mps * (_LEAST + (_MOST - _LEAST) * place)

    @classmethod
    def of_log(cls, tracks: Detections, step_s: float) -> Self | None:
        """Of a log with the stretches `tracks` of one agent's detections each, [R, 1, N]; None where no two detections tell."""
        is_told = tracks.is_observed[:, 0] & ~_is_alone(tracks)
        found = [_pair_speeds(tracks, is_told, least * step_s, _MAX_STEPS * step_s) for least in _LEAST_GAPS]
        speed, doubt = (torch.cat(column) for column in zip(*found, strict=True))
        if not len(speed):
            return None
        order = (speed - _DOUBTS[0] * doubt).argsort(descending=True)
        fastest = order[int(_SPARED * len(order))]
        seen_mps = float(speed[fastest] - _DOUBTS[1] * doubt[fastest])
        return cls(seen_mps) if seen_mps > 0.0 else None


def plausible_speed(tracks: Detections, step_s: float) -> float | None:
    """A speed that the targets of a log hardly exceed over one step of the grid, m/s; None where no two detections tell."""
    found = TopSpeed.of_log(tracks, step_s)
    return None if found is None else found.limit_mps


def _is_alone(tracks: Detections) -> Tensor:
    """Which detections [R, N] lie away from both of their neighbours."""
    place = tracks.position_m[:, 0].double()
    way_m, past_m = place.diff(dim=1).norm(dim=-1), (place[:, 2:] - place[:, :-2]).norm(dim=-1)
    is_away = (torch.minimum(way_m[:, 1:], way_m[:, :-1]) > _AWAY * past_m) & tracks.is_observed[:, 0, 2:]
    return torch.nn.functional.pad(is_away, (1, 1)) if place.shape[1] > 2 else torch.zeros_like(tracks.is_observed[:, 0])


def _pair_speeds(tracks: Detections, is_told: Tensor, least_s: float, most_s: float) -> tuple[Tensor, Tensor]:
    """Speeds [P] from each detection to the first one that is `least_s` or more later, and what noise does to them [P].

    Both must be among those [R, N] that are told of.
    """
    time_s = torch.where(tracks.is_observed, tracks.time_s, torch.inf)[:, 0].double().contiguous()
    least_s *= 1.0 - 1e-6
    later = torch.searchsorted(time_s, (time_s + least_s).contiguous())
    later = later.clamp(max=time_s.shape[1] - 1)
    gap_s = time_s.gather(1, later) - time_s
    row, first = ((gap_s >= least_s) & (gap_s <= most_s)).nonzero(as_tuple=True)
    second = later[row, first]
    is_pair = is_told[row, first] & is_told[row, second]
    row, first, second = row[is_pair], first[is_pair], second[is_pair]
    place, noise = tracks.position_m[:, 0].double(), tracks.covariance_m2[:, 0].double().diagonal(dim1=-2, dim2=-1).mean(-1)
    way_m = (place[row, second] - place[row, first]).norm(dim=-1)
    doubt_m = (noise[row, second] + noise[row, first]).sqrt()
    gap_s = gap_s[row, first]
    return way_m / gap_s, doubt_m / gap_s
