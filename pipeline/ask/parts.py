"""An area in several parts in words: how likely each is, and on which side of the others it lies."""

from typing import Any

import numpy as np
import shapely

from cadence.arrays import Float64s

_SIDES = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
_LEAST_SHARE = 0.05


def part_words(shape: Any, position_m: Float64s, weight: Float64s) -> tuple[str, list[dict[str, Any]]]:
    """`, in 2 parts: 61 % north, 39 % south`, nothing for one part; and the parts with their shares and middles.

    Parts that hold less than a twentieth of the stories in them are left out. position_m [K, 2] and weight [K] are the stories.
    """
    parts = shapely.get_parts(shape)
    held = np.array([weight[shapely.contains_xy(part, position_m[:, 0], position_m[:, 1])].sum() for part in parts])
    total = float(held.sum())
    if not total > 0:
        return "", []
    order = [int(index) for index in np.argsort(-held, kind="stable") if held[index] >= _LEAST_SHARE * total]
    found = []
    for index in order:
        others = [parts[other] for other in order if other != index]
        middle = shapely.get_coordinates(shapely.centroid(parts[index]))[0]
        away = middle - (shapely.get_coordinates(shapely.centroid(shapely.union_all(others)))[0] if others else middle)
        side = _SIDES[round(float(np.degrees(np.arctan2(away[0], away[1]))) / 45.0) % 8] if others else ""
        found.append({"share": float(held[index] / total), "side": side, "centre_m": middle.tolist()})
    if len(found) < 2:
        return "", found
    words = ", ".join(f"{100 * part['share']:.0f} % {part['side']}" for part in found)
    return f", in {len(found)} parts: {words}", found
