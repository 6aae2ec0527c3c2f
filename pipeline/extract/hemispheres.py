"""Sources in degrees that contradict each other: one has latitude and longitude exchanged, or lost a sign.

Alone such positions look as sound as any others, unless a latitude lies beyond the poles; beside the other sources of the log,
or a datum that the user states, they lie where these would, mirrored.
"""

from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np

from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.positions import Positions
from pipeline.suspicions import Suspicions

Mirrored = Literal["exchanged", "other side of Greenwich", "other side of the equator", "other side of both"]

_NEAR_DEG: Final = 1.0
_FAR_DEG: Final = 5.0
_MAX_ROWS: Final = 2048
_DATUM: Final = "extract.datum"
_MAX_SOURCES: Final = 12
"""Of many that are spread over the earth some are each other's mirror images by chance."""
_MIRRORS: Final[Mapping[Mirrored, tuple[tuple[int, int], tuple[int, int]]]] = {  # which coordinates, with which signs
    "exchanged": ((1, 0), (1, 1)),
    "other side of Greenwich": ((0, 1), (1, -1)),
    "other side of the equator": ((0, 1), (-1, 1)),
    "other side of both": ((0, 1), (-1, -1)),
}

Sources = Mapping[str, Sequence[tuple[ChannelReader, Positions]]]


def check_hemispheres(parts: Sources, datum: tuple[float, float] | None, suspicions: Suspicions) -> None:
    """Tell of sources, by role, that lie far from all others, but near them when mirrored; which are right nobody knows.

    A datum that the user stated is one more place, and the one that all are compared with.
    """
    sources = {
        reader.channel.topic: rows
        for found in parts.values()
        for reader, rows in found
        if len(rows) and rows.is_geodetic.all() and reader.source.unit is None and np.isfinite(rows.first + rows.second).any()
    }
    known = {} if datum is None else {_DATUM: np.array(datum)}
    if not 1 < len(sources) + len(known) <= _MAX_SOURCES or not suspicions.looks_for("place"):
        return
    places = {topic: _place(rows) for topic, rows in sources.items()}
    told: set[str] = set()
    for topic, place in places.items():
        others = known or {name: there for name, there in places.items() if name != topic}
        if any(_apart_deg(place, there) < _FAR_DEG for there in others.values()):
            continue
        for mirrored, (order, signs) in _MIRRORS.items():
            image = place[list(order)] * signs
            near = [name for name, there in others.items() if _apart_deg(image, there) < _NEAR_DEG]
            if near and topic not in told:
                told |= {topic, *near}
                _tell(topic, place, mirrored, near, suspicions)


def _place(rows: Positions) -> np.ndarray:
    """Median latitude and longitude [2] of what is finite."""
    places = np.column_stack([rows.first, rows.second])
    places = places[np.isfinite(places).all(axis=1)]
    return np.asarray(np.median(places[:: 1 + len(places) // _MAX_ROWS], axis=0))


def _apart_deg(one: np.ndarray, other: np.ndarray) -> float:
    latitude, longitude = np.abs(one - other)
    return float(max(latitude, min(longitude % 360, -longitude % 360)))


def _tell(topic: str, place: np.ndarray, mirrored: Mirrored, near: Sequence[str], suspicions: Suspicions) -> None:
    where = "its source" if _DATUM in near else "both sources"
    word = "latitude and longitude exchanged" if mirrored == "exchanged" else f"it on the {mirrored}"
    suspicions.add(
        "place", topic,
        seen=f"it lies about {place[0]:.4g}, {place[1]:.4g}, and with {word} it would lie near {', '.join(near[:3])}",
        done="used as it stands",
        setting=f'latitude and longitude (also "PATH.@negative"), or unit = "deg", in {where}',
    )  # fmt: skip
