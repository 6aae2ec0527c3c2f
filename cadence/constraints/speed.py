"""A speed that no step of a track exceeds, kept exactly: the nearest track whose steps are all short enough."""

import torch
from torch import Tensor

_ROUNDS = 60
_SLACK = 1e-9


def exceeds(position_m: Tensor, longest_m: float | Tensor) -> Tensor:
    """Whether a step of the tracks [..., T, 2] is longer than `longest_m`, which [..., T - 1] fits; a rounding error is not."""
    is_long: Tensor = position_m.diff(dim=-2).norm(dim=-1) > longest_m * (1.0 + 1e-6)
    return is_long.any(dim=-1)


def needed_speed(time_s: Tensor, position_m: Tensor, sigma_m: Tensor, is_observed: Tensor) -> tuple[Tensor, Tensor]:
    """The speed that two detections of a row ask for at least, each allowed to err by two sigma, and the time between them.

    Args:
        time_s: [R, N] seconds, oldest first.
        position_m: [R, N, 2].
        sigma_m: [R, N] standard deviation along an axis.
        is_observed: [R, N] False on padding, which stands last.

    Returns:
        Metres a second and seconds [R] of the two consecutive detections that ask for most; zeros where there are not two.
    """
    is_pair = is_observed[:, 1:]
    doubt_m = 2.0 * (sigma_m[:, 1:] + sigma_m[:, :-1])
    apart_m = (position_m.diff(dim=1).norm(dim=-1) - doubt_m).clamp_min(0.0)
    gap_s = time_s.diff(dim=1)
    speed = torch.where(is_pair & (apart_m > 0.0), apart_m / gap_s.clamp_min(1e-9), 0.0)
    if not speed.shape[1]:
        return torch.zeros(len(time_s), dtype=torch.float64), torch.zeros(len(time_s), dtype=torch.float64)
    fastest, pair = speed.max(dim=1)
    return fastest, torch.where(fastest > 0.0, gap_s.gather(1, pair[:, None])[:, 0], 0.0)


def limit_steps(position_m: Tensor, is_pinned: Tensor, longest_m: float | Tensor) -> tuple[Tensor, Tensor]:
    """Tracks whose steps are at most so long, and which of them could be had.

    Between two pinned steps it is the projection onto the tracks that keep both ends and the limit (Dykstra's alternating
    projections: Boyle, Dykstra 1986), drawn towards the straight way by what is left after a fixed number of rounds: the limit
    holds exactly. Before the first and after the last pinned step every step is shortened by itself.

    Args:
        position_m: [N, T, 2] metres, float64.
        is_pinned: [N, T] bool, steps that stay exactly where they are; at least one a track.
        longest_m: the limit of all steps, of each one [T - 1], or of each track's [N, 1].

    Returns:
        Tracks [N, T, 2], those that kept the limit unchanged, and whether they keep it now [N]: two pinned steps may be further
        apart than the limit allows, and such a track is left as it is between them.
    """
    is_long = exceeds(position_m, longest_m)
    moved = position_m.clone()
    if bool(is_long.any()):
        limit_m = longest_m[is_long] if isinstance(longest_m, Tensor) and longest_m.ndim == 2 else longest_m
        moved[is_long] = _limited(position_m[is_long], is_pinned[is_long], limit_m * (1.0 - _SLACK))
    return moved, ~exceeds(moved, longest_m)


def _limited(position_m: Tensor, is_pinned: Tensor, longest_m: float | Tensor) -> Tensor:
    step_m = position_m.diff(dim=1)
    legs = _Legs(is_pinned, step_m, longest_m)
    found, correction = step_m, torch.zeros_like(step_m)
    for _ in range(_ROUNDS):
        short = _shortened(found + correction, longest_m)
        correction = found + correction - short
        found = legs.closed(short)
    found = torch.where(legs.is_closed[..., None], legs.drawn_straight(found, longest_m), _shortened(step_m, longest_m))
    first = is_pinned.to(torch.int8).argmax(dim=1)
    way_m = torch.nn.functional.pad(found.cumsum(dim=1), (0, 0, 1, 0))
    rows = torch.arange(len(found))
    track = way_m + (position_m[rows, first] - way_m[rows, first])[:, None]
    return torch.where(is_pinned[..., None], position_m, track)


def _shortened(step_m: Tensor, longest_m: float | Tensor) -> Tensor:
    length = step_m.norm(dim=-1, keepdim=True)
    limit = longest_m[..., None] if isinstance(longest_m, Tensor) else longest_m
    shortened: Tensor = step_m * (limit / length.clamp_min(limit))
    return shortened


class _Legs:
    """The stretches between pinned steps of N tracks: a number for each of the T - 1 steps, and what they must add up to."""

    def __init__(self, is_pinned: Tensor, step_m: Tensor, longest_m: float | Tensor) -> None:
        number = is_pinned.cumsum(dim=1)
        self.leg = number[:, :-1]
        self.is_closed = (self.leg > 0) & (self.leg < number[:, -1:])
        self.num_legs = int(number.max()) + 1
        count = torch.zeros(len(step_m), self.num_legs, dtype=step_m.dtype)
        count.scatter_add_(1, self.leg, torch.ones_like(self.leg, dtype=step_m.dtype))
        self.count = count.gather(1, self.leg)[..., None]
        self.mean_m = self._mean(step_m)
        self.straight_m = self.mean_m
        if isinstance(longest_m, Tensor):  # the straight way is walked at one speed, not in even steps
            share = longest_m.expand(step_m.shape[:2])[..., None].expand(-1, -1, 2)
            self.straight_m = self.mean_m * share / self._mean(share)

    def _mean(self, step_m: Tensor) -> Tensor:
        """Mean step of each step's leg [N, T - 1, 2]."""
        index = self.leg[..., None].expand(-1, -1, 2)
        total = torch.zeros(len(step_m), self.num_legs, 2, dtype=step_m.dtype).scatter_add_(1, index, step_m)
        return total.gather(1, index) / self.count

    def closed(self, step_m: Tensor) -> Tensor:
        """The nearest steps that lead from each pinned step to the next."""
        return torch.where(self.is_closed[..., None], step_m + self.mean_m - self._mean(step_m), step_m)

    def drawn_straight(self, step_m: Tensor, longest_m: float | Tensor) -> Tensor:
        """The steps drawn towards their leg's straight way as far as none is too long; as they are where that cannot help."""
        away = step_m - self.straight_m
        along, square = (self.straight_m * away).sum(-1), away.square().sum(-1).clamp_min(1e-300)
        room = longest_m**2 - self.straight_m.square().sum(-1)
        share = ((along.square() + square * room).clamp_min(0.0).sqrt() - along) / square
        least = torch.ones(len(step_m), self.num_legs, dtype=step_m.dtype)
        least.scatter_reduce_(1, self.leg, share.clamp(0.0, 1.0), "amin")
        return torch.where(room[..., None] >= 0.0, self.straight_m + least.gather(1, self.leg)[..., None] * away, step_m)
