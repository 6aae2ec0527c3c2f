"""Transforms that contradict themselves: two nodes that publish one, and static ones that do not stay."""

from collections.abc import Iterable
from typing import Final

import numpy as np

from cadence.arrays import Float64s
from pipeline.extract.tracks import Track, odd_share
from pipeline.extract.transforms import Link
from pipeline.suspicions import Suspicions

_MIN_SHARE: Final = 0.15
"""Of the steps of a frame that lead away and come back at once, to a tenth of that: noise alone seldom comes back as near."""
_MIN_APART_M: Final = 1.0
_SETTING: Final = 'the recording (publish it once), extract.frame, or extract.trusted = ["place"]'


def check_links(links: Iterable[Link], suspicions: Suspicions) -> None:
    """Tell of frames that leave and come back faster than anything moves."""
    if not suspicions.looks_for("place"):
        return
    for link in links:
        if link.is_static or len(link.time_ns) < 2:
            continue
        place = link.translation_m[:, 0] + 1j * link.translation_m[:, 1]
        time_s = (link.time_ns - link.time_ns[0]) * 1e-9
        apart_m = _apart_m(place)
        if apart_m < _MIN_APART_M or odd_share(Track(time_s, place, np.zeros(len(place))), 0.0) < _MIN_SHARE:
            continue
        suspicions.add(
            "place", f"the transform {link.parent} → {link.child}",
            seen=f"it leads to places {apart_m:.3g} m apart and back from message to message, as where two nodes publish it",
            done="used as it stands", setting=_SETTING,
        )  # fmt: skip


def check_static(parent: str, child: str, poses: Float64s, suspicions: Suspicions) -> None:
    """Tell of a static transform [N, 7] that has several values."""
    apart_m = float(np.hypot(*np.ptp(poses[:, :2], axis=0)))
    if apart_m > _MIN_APART_M and suspicions.looks_for("place"):
        suspicions.add(
            "place", f"the transform {parent} → {child}",
            seen=f"it is static, but has several values, {apart_m:.3g} m apart",
            done="the last one holds throughout", setting=_SETTING,
        )  # fmt: skip


def _apart_m(place: np.ndarray) -> float:
    """How far it goes in one step, as the larger steps are that it takes in one of ten."""
    return float(np.quantile(np.abs(np.diff(place)), 1 - _MIN_SHARE))
