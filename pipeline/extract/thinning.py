"""Sparse detections out of a dense channel: seeded bursts, so that the rest can be kept as truth for scoring."""

import hashlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s


@dataclass(frozen=True)
class ThinningConfig:
    """An agent is seen in bursts: gaps and bursts alternate, their lengths exponential (an alternating renewal process).

    enabled           make detections by thinning instead of using the log's own (or, see thin_from, thin the log's own)
    thin_from         the dense channel: the truth, or the detections that the log holds
    seed              same seed, same detections; agents are independent of one another
    mean_gap_s, mean_burst_s   mean lengths in seconds; the share of time in view is burst / (gap + burst)
    min_interval_s    inside a burst, the least time between two detections; 0 keeps every sample
    noise_m           standard deviation of noise added to x and y, and stated in the covariance
    position_floor_m  standard deviation stated in the covariance in addition to the noise, added to nothing
    """

    enabled: bool = False
    thin_from: Literal["truth", "detections"] = "truth"
    seed: int = 0
    mean_gap_s: float = 8.0
    mean_burst_s: float = 1.0
    min_interval_s: float = 0.0
    noise_m: float = 0.0
    position_floor_m: float = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.mean_gap_s < np.inf and 0 < self.mean_burst_s < np.inf):
            raise ValueError("mean_gap_s and mean_burst_s must be positive")
        if not all(0 <= value < np.inf for value in (self.min_interval_s, self.noise_m, self.position_floor_m)):
            raise ValueError("min_interval_s, noise_m and position_floor_m must not be negative")
        if self.seed < 0:
            raise ValueError("seed must not be negative")

    @property
    def variance_m2(self) -> float:
        """Variance of x and of y that thinning states."""
        return self.noise_m**2 + self.position_floor_m**2


def is_seen(time_ns: Int64s, agent: str, config: ThinningConfig) -> Bools:
    """Which of one agent's samples [N], sorted by time, fall into a burst. Shifting all times changes nothing."""
    if time_ns.size == 0:
        return np.zeros(0, dtype=np.bool_)
    time_s = (time_ns - time_ns[0]) * 1e-9
    edges_s = _edges(float(time_s[-1]), config, _generator(agent, config.seed, "bursts"))
    # Edges alternate: a gap lies before edge 0, a burst between edges 0 and 1.
    seen = np.searchsorted(edges_s, time_s, side="right") % 2 == 1
    return _apart(time_s, seen, config.min_interval_s) if config.min_interval_s > 0 else seen


def noise(num_samples: int, agent: str, config: ThinningConfig) -> Float64s:
    """Noise in metres [N, 2] for one agent's samples; that of a sample does not depend on which samples are seen."""
    return _generator(agent, config.seed, "noise").normal(scale=config.noise_m, size=(num_samples, 2))


def _edges(duration_s: float, config: ThinningConfig, generator: np.random.Generator) -> Float64s:
    """Times at which bursts begin and end. Time 0 falls into a random phase: exponential lengths have no memory."""
    cycle_s = config.mean_gap_s + config.mean_burst_s
    starts_in_burst = generator.random() < config.mean_burst_s / cycle_s
    pieces: list[Float64s] = []
    reached_s = 0.0
    while reached_s <= duration_s:
        num_cycles = int((duration_s - reached_s) / cycle_s * 1.2) + 8
        means = np.tile([config.mean_gap_s, config.mean_burst_s], num_cycles)
        lengths = generator.exponential(means)
        if starts_in_burst and not pieces:
            lengths[0] = 0.0
        pieces.append(lengths)
        reached_s += float(lengths.sum())
    return np.cumsum(np.concatenate(pieces))


def _apart(time_s: Float64s, seen: Bools, min_interval_s: float) -> Bools:
    kept = np.zeros_like(seen)
    indices = np.flatnonzero(seen)
    times = time_s[indices]
    place = 0
    while place < len(indices):
        kept[indices[place]] = True
        place = max(place + 1, int(np.searchsorted(times, times[place] + min_interval_s, side="left")))
    return kept


def _generator(agent: str, seed: int, purpose: str) -> np.random.Generator:
    digest = hashlib.sha256(f"{purpose}\0{agent}".encode()).digest()
    words = np.frombuffer(digest[:16], dtype="<u4")
    return np.random.default_rng(np.random.SeedSequence([seed, *map(int, words)]))
