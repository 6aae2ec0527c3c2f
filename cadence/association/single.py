"""Whether one moving target explains a stream: then nothing asks for a second one.

The likelihood alone does not see it. A target that is met in bursts is as likely several that come and go, each of which is as
unlikely to be silent as it should be.
"""

import numpy as np

from cadence.association.particles import Stream

_ALLOWED_SIGMAS = 4.0
_MOST_OVER_USUAL_SPEED = 3.0
_LEAST_STRAIGHT, _LEAST_STRAIGHT_OF_TEN = 0.95, 0.5
_LEAST_TURNS = 8
"""Measured on single targets, thinned (8 patrols, 4 episodes of prison, a flight): at most 1.8 times their usual speed, at
least .98 and .70 straight. Streams of 12 ships, of 4 crossing targets and of 3 in rendezvous: at most .72 and .02, and some
jumps take no time."""


def is_one_target(stream: Stream, max_speed_mps: float | None = None) -> bool:
    """Whether the detections, one after the other, make a way that one target can have gone.

    No step between two detections is faster than `max_speed_mps`, or without it than a few times the usual one (the third
    quartile), beyond what noise allows; and the way from a detection to the next but one is nearly as long directly: a stream
    of several targets jumps to and fro. False where too few detections lie far enough apart to tell.
    """
    step_m = np.diff(stream.position_m, axis=0)
    variance_m2 = np.trace(stream.covariance_m2, axis1=1, axis2=2)
    length_m = np.linalg.norm(step_m, axis=-1)
    beyond_m = np.maximum(length_m - _ALLOWED_SIGMAS * np.sqrt(variance_m2[:-1] + variance_m2[1:]), 0.0)
    is_way = beyond_m > 0
    is_turn = is_way[:-1] & is_way[1:]
    if is_turn.sum() < _LEAST_TURNS:
        return False
    taken_s = np.diff(stream.time_s)[is_way]
    if not (taken_s > 0).all():
        return False
    speed_mps = beyond_m[is_way] / taken_s
    direct_m = np.linalg.norm(stream.position_m[2:] - stream.position_m[:-2], axis=-1)
    straight = direct_m[is_turn] / (length_m[:-1] + length_m[1:])[is_turn]
    most_mps = _MOST_OVER_USUAL_SPEED * np.quantile(speed_mps, 0.75) if max_speed_mps is None else max_speed_mps
    is_straight = np.median(straight) >= _LEAST_STRAIGHT and np.quantile(straight, 0.1) >= _LEAST_STRAIGHT_OF_TEN
    return bool(speed_mps.max() <= most_mps and is_straight)
