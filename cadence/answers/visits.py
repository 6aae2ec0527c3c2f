"""When each story is inside an area, exactly, on the straight lines between its steps."""

from dataclasses import dataclass, replace

import numpy as np

from cadence.answers.areas import Area, pieces_inside
from cadence.arrays import Bools, Float64s, Indices
from cadence.stories import Stories


@dataclass(frozen=True, eq=False)
class Visits:
    """Stays of N times: story [N], start_s and end_s [N] seconds, in the order of stories and of time; K stories in all."""

    story: Indices
    start_s: Float64s
    end_s: Float64s
    num_stories: int

    @property
    def is_any(self) -> Bools:
        """Stories [K] with a stay."""
        found: Bools = np.bincount(self.story, minlength=self.num_stories) > 0
        return found

    @property
    def first_s(self) -> Float64s:
        """Beginning of the first stay [K]; NaN without any."""
        found = np.full(self.num_stories, np.nan)
        found[self.story[::-1]] = self.start_s[::-1]
        return found

    @property
    def last_s(self) -> Float64s:
        """End of the last stay [K]; NaN without any."""
        found = np.full(self.num_stories, np.nan)
        found[self.story] = self.end_s
        return found

    @property
    def longest_s(self) -> Float64s:
        """Length of the longest stay [K]; 0 without any."""
        found = np.zeros(self.num_stories)
        np.maximum.at(found, self.story, self.end_s - self.start_s)
        return found

    @property
    def total_s(self) -> Float64s:
        """Length of all stays [K]."""
        return np.bincount(self.story, self.end_s - self.start_s, self.num_stories).astype(np.float64)

    def lasting(self, least_s: float) -> "Visits":
        """The stays of at least `least_s`."""
        return self[self.end_s - self.start_s >= least_s]

    def after(self, time_s: float) -> "Visits":
        """The stays that begin later than `time_s`."""
        return self[self.start_s > time_s]

    def __getitem__(self, chosen: Bools) -> "Visits":
        """A selection of the stays."""
        return Visits(self.story[chosen], self.start_s[chosen], self.end_s[chosen], self.num_stories)

    def __len__(self) -> int:
        return len(self.story)


def between(stories: Stories, agents: tuple[int, ...], from_s: float, to_s: float) -> Stories:
    """The stories of some agents from one time to another, cut exactly there; ValueError where nothing is known of that time.

    Only these agents' positions are copied: those of all agents of a long mission may fill the memory.
    """
    chosen = stories.of(agents)
    first, last = max(from_s, float(stories.time_s[0])), min(to_s, float(stories.time_s[-1]))
    if not first <= last:
        raise ValueError(f"nothing is known between {from_s:g} s and {to_s:g} s")
    if first == stories.time_s[0] and last == stories.time_s[-1]:
        return chosen
    left, right = int(np.searchsorted(stories.time_s, first, "right")) - 1, int(np.searchsorted(stories.time_s, last)) + 1
    near = replace(chosen, time_s=chosen.time_s[left:right], position_m=chosen.position_m[:, :, left:right])
    inner = near.time_s[(near.time_s > first) & (near.time_s < last)]
    time_s = np.unique(np.concatenate([[first], inner, [last]]))
    return replace(near, time_s=time_s, position_m=near.at(time_s))


def visits(time_s: Float64s, track_m: Float64s, area: Area) -> Visits:
    """The stays of tracks [K, T, 2] in `area`; where a track is absent (NaN) it is in no area."""
    if len(time_s) == 1:  # a moment is a stay without length
        time_s, track_m = np.repeat(time_s, 2), np.repeat(track_m, 2, axis=1)
    near = _near_steps(track_m, area)
    start_m, end_m = track_m[:, near].reshape(-1, 2), track_m[:, near + 1].reshape(-1, 2)
    known = np.flatnonzero(np.isfinite(start_m).all(1) & np.isfinite(end_m).all(1))
    piece, first, last = pieces_inside(start_m[known], end_m[known], area)
    story, step = np.divmod(known[piece], max(len(near), 1))
    step = near[step]
    left, right = time_s[step], time_s[step + 1]
    start_s, end_s = (np.where(share == 1, right, left + share * (right - left)) for share in (first, last))
    return _joined(story, start_s, end_s, len(track_m))


def _near_steps(track_m: Float64s, area: Area) -> Indices:
    """Steps from which any of the tracks [K, T, 2] may lead into an area, by a look at the box of all of them."""
    if not len(track_m):
        return np.zeros(0, dtype=np.intp)
    low, high = np.fmin.reduce(track_m, axis=0), np.fmax.reduce(track_m, axis=0)
    low, high = np.fmin(low[:-1], low[1:]), np.fmax(high[:-1], high[1:])
    west, south, east, north = area.bounds_m
    # where no track is the box is NaN, which meets nothing
    return np.flatnonzero((low[:, 0] <= east) & (high[:, 0] >= west) & (low[:, 1] <= north) & (high[:, 1] >= south))


def _joined(story: Indices, start_s: Float64s, end_s: Float64s, num_stories: int) -> Visits:
    """Pieces that follow each other without a break are one stay."""
    is_new = np.ones(len(story), dtype=bool)
    is_new[1:] = (story[1:] != story[:-1]) | (start_s[1:] > end_s[:-1])
    first = np.flatnonzero(is_new)
    last = np.append(first[1:], len(story)) - 1 if len(first) else first
    return Visits(story[first], start_s[first], end_s[last], num_stories)
