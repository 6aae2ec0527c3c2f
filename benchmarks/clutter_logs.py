"""Streams of detections without identity, with clutter: every 20 s a radar sees some of four targets.

Targets cross, go side by side, or appear and leave; clutter lies evenly over the area.
"""

from typing import Final, Literal, get_args

import numpy as np

from benchmarks.association_logs import Log
from cadence.arrays import Bools, Float64s

Scene = Literal["crossing", "parallel", "appear and leave"]
SCENES: Final[tuple[Scene, ...]] = get_args(Scene)

_NUM_TARGETS, _SCAN_S, _NUM_SCANS, _SIGMA_M, _HALF_M = 4, 20.0, 240, 40.0, 8000.0
_SPEED_MPS, _WEAVE_RAD, _WEAVE_S = 6.0, 0.4, 900.0
_DETECTION_SHARE = 0.4
_APART_M = 400.0


def clutter_log(scene: Scene, clutter_share: float, seed: int) -> Log:
    """One stream; `clutter_share` of its detections are clutter, whose origin is -1."""
    rng = np.random.default_rng([seed, SCENES.index(scene), round(100 * clutter_share)])
    scan_s = _SCAN_S * np.arange(_NUM_SCANS)
    track_m, is_there = _tracks(scene, scan_s, rng)
    target, scan = np.nonzero(is_there & (rng.random(is_there.shape) < _DETECTION_SHARE))
    num_clutter = rng.poisson(len(scan) * clutter_share / (1.0 - clutter_share))
    position_m = np.concatenate(
        [track_m[target, scan] + rng.normal(0.0, _SIGMA_M, (len(scan), 2)), rng.uniform(-_HALF_M, _HALF_M, (num_clutter, 2))]
    )
    time_s = np.concatenate([scan_s[scan], rng.choice(scan_s, num_clutter)])
    origin = np.concatenate([target, np.full(num_clutter, -1)])
    order = np.argsort(time_s, kind="stable")
    truth_m = np.where(is_there[..., None], track_m, np.nan)[:, ::6]
    return Log(time_s[order], position_m[order], _SIGMA_M, origin[order], scan_s[::6], truth_m, None, 1000.0, _SPEED_MPS)


def _tracks(scene: Scene, time_s: Float64s, rng: np.random.Generator) -> tuple[Float64s, Bools]:
    """Positions [A, T, 2] of targets that weave about a course, and when they are there [A, T]."""
    heading = rng.uniform(-np.pi, np.pi, _NUM_TARGETS)
    is_there = np.ones((_NUM_TARGETS, len(time_s)), np.bool_)
    if scene == "parallel":
        heading[:] = heading[0]
    phase = rng.uniform(0.0, 2.0 * np.pi, _NUM_TARGETS) if scene != "parallel" else np.zeros(_NUM_TARGETS)
    angle = heading[:, None] + _WEAVE_RAD * np.sin(2.0 * np.pi * time_s / _WEAVE_S + phase[:, None])
    speed_mps = _SPEED_MPS * rng.uniform(0.5, 1.0, (_NUM_TARGETS if scene != "parallel" else 1, 1))
    step_m = (speed_mps * (time_s[1] - time_s[0]))[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    track_m = np.cumsum(step_m, axis=1)
    track_m -= track_m[:, len(time_s) // 2][:, None]
    aside = np.array([-np.sin(heading[0]), np.cos(heading[0])])
    if scene == "parallel":
        track_m += _APART_M * (np.arange(_NUM_TARGETS) - 1.5)[:, None, None] * aside
    else:
        track_m += rng.uniform(-0.3 * _HALF_M, 0.3 * _HALF_M, (_NUM_TARGETS, 1, 2))
    if scene == "appear and leave":
        is_there[0, : len(time_s) // 3], is_there[1, 2 * len(time_s) // 3 :] = False, False
    return track_m, is_there
