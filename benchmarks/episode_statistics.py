"""What episodes of a world are like as a whole, and how far two sets of them are apart."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from cadence.arrays import Float64s, Int64s
from cadence.recordings import Recordings

MEASURES = ("length", "rate", "gap", "stride")
"""Names of the samples that two sets are compared by."""


@dataclass(frozen=True, eq=False)
class EpisodeStatistics:
    """Samples over E episodes.

    length [E] steps; rate [E] share of steps with a detection
    gap    [G] steps from a detection to the next where they are more than one
    stride [S] length of the target's steps, in the unit given
    site   [E] index of the site where an episode ended, -1 where it ended at none
    """

    length: Float64s
    rate: Float64s
    gap: Float64s
    stride: Float64s
    site: Int64s

    def share_at(self, first: int, stop: int) -> float:
        """Share of the episodes that ended at one of the sites first ... stop - 1."""
        return float(((self.site >= first) & (self.site < stop)).mean())


@dataclass(frozen=True)
class Distance:
    """How far two samples are apart: the largest difference of their distribution functions, and the area between these.

    `area` (the Wasserstein distance) has the unit of the samples; `chance` is the probability of so large a difference
    between samples of one distribution, were all values independent (gaps and strides of one episode are not).
    """

    largest: float
    area: float
    chance: float


def episode_statistics(recordings: Recordings, unit_m: float, sites_m: Float64s, radius_m: float) -> EpisodeStatistics:
    """Samples of `recordings`; sites_m [G, 2] in the mission frame, an episode ends at one within `radius_m` of it."""
    place = recordings.position_m.astype(np.float64)
    final = place[recordings.offset[1:] - 1]
    distance = np.hypot(*np.moveaxis(final[:, None] - sites_m, -1, 0))
    seen = np.flatnonzero(recordings.is_detected)
    episode = np.searchsorted(recordings.offset, seen, side="right")
    gap = np.diff(seen)
    strides = np.hypot(*np.diff(place, axis=0).T) / unit_m
    within = np.ones(len(strides), dtype=bool)
    within[recordings.offset[1:-1] - 1] = False
    return EpisodeStatistics(
        recordings.length.astype(np.float64),
        recordings.rates(),
        gap[(np.diff(episode) == 0) & (gap > 1)].astype(np.float64),
        # Whole cells in metres are not exact in float32.
        np.round(strides[within], 3),
        np.where(distance.min(axis=1) <= radius_m, distance.argmin(axis=1), -1),
    )


def compare(one: EpisodeStatistics, other: EpisodeStatistics) -> dict[str, Distance]:
    """Distances by measure."""
    found = {}
    for name in MEASURES:
        a, b = getattr(one, name), getattr(other, name)
        test = stats.ks_2samp(a, b, method="asymp")
        found[name] = Distance(float(test.statistic), float(stats.wasserstein_distance(a, b)), float(test.pvalue))
    return found


def site_difference(one: EpisodeStatistics, other: EpisodeStatistics, num_sites: int) -> float:
    """Total variation distance between the distributions over the sites where episodes end."""
    shares = [np.bincount(item.site + 1, minlength=num_sites + 1) / len(item.site) for item in (one, other)]
    return float(0.5 * np.abs(shares[0] - shares[1]).sum())
