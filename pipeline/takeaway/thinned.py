"""Tracks with the steps that matter: what a straight line at even speed gives anyway is left out."""

import functools

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from pipeline.takeaway.answer import Answer, Track

TOLERANCE_M = 0.05


@functools.lru_cache(maxsize=1)
def thin_tracks(answer: Answer, num_hypotheses: int) -> tuple[Track, ...]:
    """The heaviest hypotheses of a mission, thinned once for all formats."""
    return tuple(map(thinned, answer.tracks(num_hypotheses)))


@functools.lru_cache(maxsize=1)
def thin_means(answer: Answer) -> tuple[Track, ...]:
    """The means of a mission, thinned once for all formats."""
    return tuple(map(thinned, answer.means()))


def thinned(track: Track, tolerance_m: float = TOLERANCE_M) -> Track:
    """The track with so many steps that it is nowhere further than `tolerance_m` from where it was at that time.

    The place at a time between two steps is the straight line between them (Douglas and Peucker 1973, with the distance of
    Meratnia and de By 2004: to where the line is at that time, not to the line).
    """
    if len(track) < 3:
        return track
    values = track.position_m if track.height_m is None else np.column_stack([track.position_m, np.nan_to_num(track.height_m)])
    return track.at(np.flatnonzero(_kept(track.time_ns, values, tolerance_m)))


def _kept(time_ns: Int64s, values: Float64s, tolerance: float) -> Bools:
    """Which steps [T] of values [T, D] are needed."""
    kept = np.zeros(len(time_ns), np.bool_)
    kept[[0, -1]] = True
    open_spans = [(0, len(time_ns) - 1)]
    while open_spans:
        first, last = open_spans.pop()
        if last - first < 2:
            continue
        share = (time_ns[first + 1 : last] - time_ns[first]) / (time_ns[last] - time_ns[first])
        line = values[first] + share[:, None] * (values[last] - values[first])
        away = np.linalg.norm(values[first + 1 : last] - line, axis=1)
        worst = int(away.argmax())
        if away[worst] > tolerance:
            middle = first + 1 + worst
            kept[middle] = True
            open_spans += [(first, middle), (middle, last)]
    return kept
