"""The detection law of the paper's two worlds, for a batch of episodes at one step.

With R = factor * c * k * v (c the coverage where the sensor stands, k the kind of sensor, v the target's speed, all lengths
in the world's unit) a sensor detects a target within R surely, at 3 R never, and with a probability falling linearly in
between; every sensor draws on its own at every step, and a detection is exact [facts: authors' simulators, class
DetectionObject]. A target that stands still cannot be detected.
"""

import numpy as np

from cadence.arrays import Bools, Float64s
from cadence.worlds.draws import Draws
from cadence.worlds.episode import SensorLaw

_NUM_POINTS = 31
REACH = 3.0
"""Ranges R at which the probability has fallen to zero."""


def detection_probability(distance: Float64s, sure_range: Float64s) -> Float64s:
    """Probability that a sensor with range R = `sure_range` detects a target at `distance`; the arrays broadcast."""
    distance, sure_range = np.broadcast_arrays(distance, sure_range)
    ratio = np.divide(distance, sure_range, out=np.full(distance.shape, np.inf), where=sure_range > 0)
    probability: Float64s = np.clip((REACH - ratio) / (REACH - 1.0), 0.0, 1.0)
    return probability


def mean_law(sure_range_m: Float64s) -> SensorLaw:
    """P(detect) over metres of a sensor whose range was `sure_range_m` [N] in turn: their mean."""
    distance_m = np.linspace(0.0, max(REACH * float(sure_range_m.max(initial=0.0)), 1e-3), _NUM_POINTS)
    probability = detection_probability(distance_m[:, None], sure_range_m).mean(axis=1)
    return SensorLaw(distance_m, np.round(probability, 4))


def detect(draws: Draws, stream: int, step: int, sensors: Float64s, target: Float64s, sure_range: Float64s) -> Bools:
    """Which of the sensors detect the target of their episode at this step: [B, S].

    sensors [B, S, 2] or, the same in all episodes, [S, 2]; target [B, 2]; sure_range [B, S], R of every sensor (0: off).
    `stream` must be used for nothing else.
    """
    offset = sensors - target[:, None]
    square = (offset * offset).sum(axis=-1)
    limit = REACH * sure_range
    row, sensor = np.nonzero(square < limit * limit)
    probability = detection_probability(np.sqrt(square[row, sensor]), sure_range[row, sensor])
    hit = np.zeros(square.shape, dtype=bool)
    hit[row, sensor] = draws.uniform(row, stream, step, sensor) < probability
    return hit
