"""Lines with no more points than can be seen."""

import numpy as np

from cadence.arrays import Bools, Float64s


def visible_vertices(track_m: Float64s, origin_index: int, tolerance_m: float) -> Bools:
    """Which steps [K, T] of tracks [K, T, 2 or 3] need a point so that no step lies farther from its line than the tolerance.

    The ends and the origin always do. After Douglas and Peucker (1973), "Algorithms for the reduction of the number of points
    required to represent a digitized line or its caricature"; every stretch of every track is halved at once.
    """
    num_tracks, num_steps = track_m.shape[:2]
    point_m = track_m.reshape(-1, track_m.shape[-1])
    is_kept = np.zeros((num_tracks, num_steps), dtype=bool)
    is_kept[:, [0, origin_index, -1]] = True
    flat = is_kept.reshape(-1)
    while True:
        first = np.flatnonzero(flat)  # of each stretch; the last step of a track is a stretch by itself
        stretch = np.cumsum(flat) - 1
        begin_m, end_m = point_m[first[stretch]], point_m[np.append(first[1:], len(flat) - 1)[stretch]]
        away_m = _distance_m(point_m, begin_m, end_m)
        is_farthest = away_m == np.maximum.reduceat(away_m, first)[stretch]
        is_new = is_farthest & (away_m > tolerance_m) & ~flat
        if not is_new.any():
            return is_kept
        flat |= is_new


def _distance_m(point_m: Float64s, begin_m: Float64s, end_m: Float64s) -> Float64s:
    """Of points [N, D] to straight pieces between two points each [N, D]."""
    chord_m, from_begin_m = end_m - begin_m, point_m - begin_m
    length_m2 = np.maximum(np.einsum("nd,nd->n", chord_m, chord_m), 1e-300)
    share = np.clip(np.einsum("nd,nd->n", from_begin_m, chord_m) / length_m2, 0.0, 1.0)
    apart_m = from_begin_m - share[:, None] * chord_m
    flat_m = np.hypot(apart_m[:, 0], apart_m[:, 1])
    return np.asarray(flat_m if apart_m.shape[1] == 2 else np.hypot(flat_m, apart_m[:, 2]))
