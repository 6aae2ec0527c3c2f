"""How exact heights are that do not say so: the noise of greatest likelihood, and never less than rounding leaves.

Altimeters of aircraft state steps of 25 or 100 feet, receivers whole metres: heights that are rounded to a step are off by
its twelfth root (the deviation of a uniform law), however steady they look.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from scipy.interpolate import Akima1DInterpolator

from cadence.arrays import Float64s
from cadence.height.bank import HeightTrack
from cadence.height.filtering import Nodes, Switching, filter_forward
from cadence.height.fitting import DIFFUSE_STEPS
from cadence.height.modes import default_modes

_MIN_ROWS, _ROWS, _MAX_STRETCHES = 4, 24, 36
_MAX_GAPS: Final = 4.0
"""Detections further apart than so many typical gaps say nothing of each other's noise."""
_NUM_TRIED, _NUM_READ = 25, 500
_RANGE: Final = 300.0
"""From the largest noise that is tried, as if nothing but noise were rough, to the smallest."""
_DROP: Final = 1.92
"""Half the 95 % quantile of chi squared with one degree of freedom."""
_MODEL_ERROR: Final = 0.1
"""Modes are not quite those of real targets: simulated noise comes out up to so much too small."""
_MIN_CHANGES: Final = 8
_MIN_STEPS: Final = 2
_LEAST_STEP_M: Final = 0.01
"""Nobody rounds to less than a centimetre."""
_NUM_STEPS: Final = 6
"""Of the smallest changes, those that are tried: now and then one altimeter of many states finer steps."""
_MOST_MULTIPLE: Final = 20.0
_MOST: Final = 0.95
_EXACT: Final = 0.02
"""So many heights must change so often, by whole multiples of one step up to this share of it, to be called rounded."""


@dataclass(frozen=True)
class HeightNoise:
    """Standard deviation of a source's heights, its interval of 95 %, and the step to which they are rounded (0: none)."""

    sigma_m: float
    interval_m: tuple[float, float]
    rounded_to_m: float

    @property
    def is_sure(self) -> bool:
        """Whether heights without noise are ruled out."""
        return self.interval_m[0] > 0


def height_noise(tracks: Sequence[HeightTrack]) -> HeightNoise | None:
    """The noise that the heights of a source's tracks have in common; None where they hold too little to tell."""
    stretches = _stretches(tracks)
    if not stretches:
        return None
    step_m = rounding_m(tracks)
    least_m, most_m = step_m / math.sqrt(12.0), _roughness_m(stretches)
    if most_m <= least_m or most_m < 1e-6:
        return HeightNoise(least_m, (least_m, max(least_m, most_m)), step_m)
    coarse_m = np.geomspace(max(most_m / _RANGE, least_m), 1.5 * most_m, _NUM_TRIED)
    tried_m = np.geomspace(coarse_m[0], coarse_m[-1], _NUM_READ)
    found = Akima1DInterpolator(np.log(coarse_m), _log_likelihoods(stretches, coarse_m))(np.log(tried_m))
    best = int(found.argmax())
    inside = np.flatnonzero(found >= found[best] - _DROP)
    low_m = least_m if inside[0] == 0 else (1.0 - _MODEL_ERROR) * float(tried_m[inside[0]])
    sigma_m = least_m if best == 0 else float(tried_m[best])
    return HeightNoise(sigma_m, (max(low_m, least_m), (1.0 + _MODEL_ERROR) * float(tried_m[inside[-1]])), step_m)


def rounding_m(tracks: Sequence[HeightTrack]) -> float:
    """The largest step of which nearly all changes of height are multiples; 0 where there is none."""
    change = np.abs(np.concatenate([np.diff(track.height_m) for track in tracks]))
    change = change[change > 1e-6]
    if len(change) < _MIN_CHANGES:
        return 0.0
    steps_m = np.unique(np.round(change, 3))
    tried_m = steps_m[steps_m >= _LEAST_STEP_M][:_NUM_STEPS].tolist()
    return max((step_m for step_m in tried_m if _is_step(step_m, change)), default=0.0)


def _is_step(step_m: float, change_m: Float64s) -> bool:
    """Whether changes are whole multiples of a step; of small multiples only, as any large number is near to one."""
    multiple = change_m / step_m
    is_whole = np.abs(multiple - np.round(multiple)) <= _EXACT
    is_telling = multiple < _MOST_MULTIPLE
    return bool(
        is_telling.sum() >= _MIN_CHANGES
        and is_whole[is_telling].mean() >= _MOST
        and (np.round(multiple) == 1).sum() >= _MIN_STEPS
    )


def _stretches(tracks: Sequence[HeightTrack]) -> list[HeightTrack]:
    """Parts of tracks without long gaps, evenly spread."""
    gaps = np.concatenate([np.diff(track.time_s) for track in tracks]) if tracks else np.zeros(0)
    gaps = gaps[gaps > 0]
    if not len(gaps):
        return []
    longest_s, found = _MAX_GAPS * float(np.median(gaps)), []
    for track in tracks:
        is_new = np.diff(track.time_s, prepend=-np.inf) > 0
        time_s, height_m = track.time_s[is_new], track.height_m[is_new]
        for part in np.split(np.arange(len(time_s)), np.flatnonzero(np.diff(time_s) > longest_s) + 1):
            for begin in range(0, len(part), _ROWS):
                rows = part[begin : begin + _ROWS]
                if len(rows) >= _MIN_ROWS:
                    found.append(HeightTrack(time_s[rows], height_m[rows], np.zeros(len(rows))))
    chosen = np.linspace(0, len(found) - 1, min(len(found), _MAX_STRETCHES)).round().astype(int)
    return [found[index] for index in chosen]


def _roughness_m(stretches: Sequence[HeightTrack]) -> float:
    """Standard deviation if all that is not straight between neighbours were noise; never less than the noise is."""
    squares = []
    for track in stretches:
        before_s, after_s = np.diff(track.time_s)[:-1], np.diff(track.time_s)[1:]
        share = after_s / (before_s + after_s)
        line_m = share * track.height_m[:-2] + (1.0 - share) * track.height_m[2:]
        squares.append((track.height_m[1:-1] - line_m) ** 2 / (1.0 + share**2 + (1.0 - share) ** 2))
    return float(np.sqrt(np.concatenate(squares).mean()))


def _log_likelihoods(stretches: Sequence[HeightTrack], sigma_m: Float64s) -> Float64s:
    """Log likelihood of all stretches under each standard deviation [G], whatever the modes."""
    num = max(len(track.time_s) for track in stretches)
    time_s, height_m = (
        np.stack([np.pad(getattr(t, name), (0, num - len(t.time_s)), mode="edge") for t in stretches])
        for name in ("time_s", "height_m")
    )
    is_seen = np.arange(num) < np.array([[len(track.time_s)] for track in stretches])
    step_s = float(np.median(np.diff(time_s)[is_seen[:, 1:]]))
    rates = (np.diff(height_m) / np.maximum(np.diff(time_s), 1e-9))[is_seen[:, 1:]]
    rate_mps = max(float(np.sqrt((rates**2).mean())), 1e-6)
    modes, prior = default_modes()
    switching = Switching(modes.scaled(step_s, rate_mps), prior.log())
    total = []
    for sigma in sigma_m:
        variance = torch.full(time_s.shape, float(sigma) ** 2, dtype=torch.float64)
        nodes = Nodes(torch.from_numpy(time_s), torch.from_numpy(height_m), variance, torch.from_numpy(is_seen))
        total.append(float(filter_forward(switching, nodes, DIFFUSE_STEPS * rate_mps * step_s).log_likelihood.sum()))
    return np.array(total)
