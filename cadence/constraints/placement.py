"""When a track is where on its new way: steps laid along a path with the rhythm of the old one, corners hit exactly."""

import numpy as np

from cadence.arrays import Float64s


def arc_length(path: Float64s) -> Float64s:
    """Length [P] walked at every vertex of a path [P, 2]."""
    step = np.diff(path, axis=0)
    return np.concatenate([np.zeros(1), np.cumsum(np.hypot(step[:, 0], step[:, 1]))])


def along(path: Float64s, walked: Float64s) -> Float64s:
    """The points [N, 2] of a path [P, 2] after the lengths `walked` [N]."""
    length = arc_length(path)
    return np.stack([np.interp(walked, length, path[:, axis]) for axis in (0, 1)], axis=1)


def place(old: Float64s, path: Float64s, corners: Float64s, length: float) -> Float64s | None:
    """Positions [n, 2] on `path` for the steps that were at old [n, 2]; the first at its start, the last at `length`.

    In between the share of the way walked is as it was, but every corner (given by its length along the path) is hit by
    one step, so that no chord cuts it. None where there are more corners than steps between the first and the last.
    """
    corners = corners[(corners > 0) & (corners < length)]
    if len(corners) > len(old) - 2:
        return None
    walked = arc_length(old)
    # A track that never moved has no rhythm: spread it evenly.
    share = walked / walked[-1] if walked[-1] > 0 else np.linspace(0.0, 1.0, len(old))
    return along(path, _hit(share * length, corners))


def _hit(target: Float64s, corners: Float64s) -> Float64s:
    """`target` [n], not decreasing, warped so that every corner [m] is the value of one inner step."""
    if not len(corners):
        return target
    nearest = np.searchsorted((target[1:] + target[:-1]) / 2, corners)
    chosen: list[int] = []
    count = len(corners)
    for rank, step in enumerate(nearest.tolist()):
        lowest = chosen[-1] + 1 if chosen else 1
        chosen.append(min(max(step, lowest), len(target) - 1 - count + rank))
    knots = [0, *chosen, len(target) - 1]
    values = [target[0], *corners, target[-1]]
    warped = target.copy()
    for left, right, low, high in zip(knots[:-1], knots[1:], values[:-1], values[1:], strict=True):
        part = target[left : right + 1]
        span = part[-1] - part[0]
        share = (part - part[0]) / span if span > 0 else np.linspace(0.0, 1.0, len(part))
        warped[left : right + 1] = low + share * (high - low)
    return warped
