"""Heights of mission hypotheses: drawn beside the plane, given all heights that were detected."""

from collections.abc import Sequence

import numpy as np

from cadence.arrays import Float64s
from cadence.height.bank import HeightBank, HeightTrack
from cadence.seeds import derived_seeds
from pipeline.retrospect.sources import Share


def heights_beside(
    bank: HeightBank, shares: Sequence[Share], position_m: Float64s, time_s: Float64s, start_ns: int, seed: int
) -> Float64s:
    """Heights [K, A, T] where positions [K, A, T, 2] are, each track's by a seed of its own; NaN where nothing is known.

    Args:
        bank: fitted to the log.
        shares: the tracks, and in which stories each of them is.
        position_m: in the plane, NaN where an agent is no part of a story.
        time_s: [T] since `start_ns`.
        start_ns: when `time_s` is zero.
        seed: of all of them.
    """
    found = np.full(position_m.shape[:3], np.nan)
    seeds = derived_seeds(seed, "heights", np.arange(len(shares)))
    for share, own_seed in zip(shares, seeds.tolist(), strict=True):
        track = share.track
        if track.height_m is None or track.height_variance_m2 is None:
            continue
        steps = np.flatnonzero(np.isfinite(position_m[share.stories[0], share.agent, :, 0]))
        seen = HeightTrack(np.asarray((track.time_ns - start_ns) * 1e-9, np.float64), track.height_m, track.height_variance_m2)
        drawn = bank.on_times([seen], time_s[steps], len(share.stories), own_seed)[:, 0]
        found[share.stories[:, None], share.agent, steps] = drawn
    return found
