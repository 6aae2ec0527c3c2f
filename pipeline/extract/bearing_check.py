"""Bearings against the detections of the same agents: what points elsewhere all the time is not what it is taken for.

A compass bearing that is read as an angle from east, a heading or a declination that is forgotten, degrees in fields of
radians: such bearings would be believed to a degree, and draw their agents to a wrong place. They are compared where an agent
was detected shortly before and after.
"""

from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s
from pipeline.extract.positions import Positions
from pipeline.extract.sightings import Sightings
from pipeline.suspicions import Suspicions

_LEAST: Final = 5
"""Bearings of a topic that can be compared."""
_MOST_BLUR: Final = 0.1
"""How far off a place between two detections may be, over its distance: radians."""
_SIGMAS: Final = 5.0
_LEAST_RAD: Final = 0.15
_FITS: Final = 0.5
"""Of the error as it is, that of what it may be meant as."""


def without_contradicted(rows: Sightings, detections: Positions, suspicions: Suspicions) -> Sightings:
    """The paired sightings [2 N], in metres as detections [M] are, without bearings of topics that point elsewhere."""
    if not suspicions.looks_for("place"):
        return rows
    numbers = rows.numbers.copy()
    for topic, of_topic in zip(rows.topics.names, rows.topics.rows(), strict=True):
        bearing, sigma, error = _errors(rows[of_topic], detections)
        if len(error) < _LEAST:
            continue
        apart = float(np.median(np.abs(error)))
        if apart <= max(_LEAST_RAD, _SIGMAS * float(np.median(sigma))):
            continue
        suspicions.add(
            "place", topic,
            seen=f"{len(error)} bearings are off by {np.degrees(apart):.3g} degrees in the median from where the same agents "
            f"were detected just before and after{_meant(bearing, error)}",
            done="its bearings are left out",
            setting="bearing_convention, bearing_unit or observer_heading_deg in its [[extract.detections]], or "
            'extract.trusted = ["place"]',
        )  # fmt: skip
        numbers[of_topic, 1:3] = np.nan
    is_left = np.isfinite(numbers[:, [0, 1, 3]]).any(axis=1)
    return rows.changed(numbers=numbers)[is_left]


def _errors(rows: Sightings, detections: Positions) -> tuple[Float64s, Float64s, Float64s]:
    """Of the bearings of a topic that can be compared [K]: bearing, standard deviation, measured less expected."""
    order = np.argsort(rows.key, kind="stable")
    sensors, ends = (rows[order[rows.is_sensor[order] == is_sensor]] for is_sensor in (True, False))
    bearing = np.arctan2(ends.second - sensors.second, ends.first - sensors.first)
    place_m = np.full((len(sensors), 2), np.nan)
    blur_m = np.full(len(sensors), np.inf)
    for name, of_agent in zip(sensors.agents.names, sensors.agents.rows(), strict=True):
        track = detections[np.array([each == name for each in detections.agent], dtype=np.bool_)]
        if len(track) > 1:
            place_m[of_agent], blur_m[of_agent] = _between(track, sensors.time_ns[of_agent])
    east, north = place_m[:, 0] - sensors.first, place_m[:, 1] - sensors.second
    is_known: Bools = np.isfinite(sensors.numbers[:, 1]) & (blur_m < _MOST_BLUR * np.hypot(east, north))
    error = np.angle(np.exp(1j * (bearing - np.arctan2(north, east))))
    return bearing[is_known], sensors.numbers[is_known, 5], error[is_known]


def _between(track: Positions, at_ns: np.ndarray) -> tuple[Float64s, Float64s]:
    """Places [K, 2] of a track at moments [K] between two detections, and how far off they may be [K]; infinite outside."""
    order = np.argsort(track.time_ns, kind="stable")
    time_ns, place_m = track.time_ns[order], np.column_stack([track.first, track.second])[order]
    after = np.clip(np.searchsorted(time_ns, at_ns), 1, len(time_ns) - 1)
    before = after - 1
    share = (at_ns - time_ns[before]) / np.maximum(time_ns[after] - time_ns[before], 1)
    found = place_m[before] + share[:, None] * (place_m[after] - place_m[before])
    sigma_m = np.sqrt(np.nan_to_num(track.covariance_m2[order][:, [0, 2]]).max(axis=1))
    blur_m = np.hypot(*(place_m[after] - place_m[before]).T) + 3.0 * np.maximum(sigma_m[before], sigma_m[after])
    return found, np.where((share >= 0) & (share <= 1), blur_m, np.inf)


def _meant(bearing_rad: Float64s, error_rad: Float64s) -> str:
    """In words what the bearings may be meant as, by what would fit."""
    expected = bearing_rad - error_rad
    turn = float(np.angle(np.exp(1j * error_rad).mean()))
    ways = {
        "; from north clockwise, or from east and not, they would fit": np.pi / 2 - bearing_rad,
        "; the other way round they would fit": -bearing_rad,
        f"; all turned by {-np.degrees(turn):.3g} degrees they would fit": bearing_rad - turn,
    }
    median = {words: float(np.median(np.abs(np.angle(np.exp(1j * (way - expected)))))) for words, way in ways.items()}
    best = min(median, key=lambda words: median[words])
    return best if median[best] < min(_FITS * float(np.median(np.abs(error_rad))), _LEAST_RAD) else ""
