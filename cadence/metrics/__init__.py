"""Pure functions from hypotheses and truth to numbers. Everything is float64, and every mean respects the weights.

Shapes everywhere: hypotheses position_m [B, K, A, T, 2], weight [B, K] (rows sum to one), truth_m [B, A, T, 2], is_known
[B, A, T]. Functions of one step return [B, A, T]; what they hold where the truth is unknown is undefined (usually NaN).
"""

from cadence.metrics.bootstrap import Interval, bootstrap_mean, bootstrap_ratio
from cadence.metrics.calibration import coverage, density_rank
from cadence.metrics.map_score import map_density, map_score, ring_density
from cadence.metrics.position import ade, expected_distance, masked_mean, mean_error, min_ade, min_ade_distance, spread
from cadence.metrics.scores import energy_score, trajectory_energy_score
from cadence.metrics.sets import Gospa, gospa, ospa

__all__ = [
    "Gospa",
    "Interval",
    "ade",
    "bootstrap_mean",
    "bootstrap_ratio",
    "coverage",
    "density_rank",
    "energy_score",
    "expected_distance",
    "gospa",
    "map_density",
    "map_score",
    "masked_mean",
    "mean_error",
    "min_ade",
    "min_ade_distance",
    "ospa",
    "ring_density",
    "spread",
    "trajectory_energy_score",
]
