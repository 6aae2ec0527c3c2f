"""What a stream turned out to be: how many agents, how much clutter, how often one is detected, with how sure that is."""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.association.types import CLUTTER, AssociationHypotheses

_NORMAL_95 = 1.96
_LEAST_PER_SCAN = 1.2
"""So many detections a moment, on average, make scans of moments: then a share of them is a probability of detection."""


@dataclass(frozen=True)
class Share:
    """A share and its interval of 95 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class StreamCounts:
    """What association hypotheses count in a stream.

    num_agents       the likeliest number; num_agents_probability how likely, low and high the range of 95 %
    clutter          share of the detections that nobody caused
    detection        share of the scans between its first and last detection in which an agent is detected; None: no scans
    mean_gap_s       between two detections of an agent; None where none has two
    """

    num_agents: int
    num_agents_probability: float
    num_agents_low: int
    num_agents_high: int
    clutter: Share
    detection: Share | None
    mean_gap_s: float | None


def stream_counts(associations: AssociationHypotheses, time_s: Float64s) -> StreamCounts:
    """The counts over all association hypotheses of the detections at times [N]."""
    weight = associations.weight
    numbers = np.array([len(np.unique(label[label != CLUTTER])) for label in associations.label])
    values = np.unique(numbers)
    probability = np.array([weight[numbers == value].sum() for value in values])
    low, high = np.searchsorted(np.cumsum(probability), [0.025, 0.975])
    best = int(probability.argmax())
    clutter = [(int((label == CLUTTER).sum()), associations.num_detections) for label in associations.label]
    moments = np.unique(time_s)
    scans = [_scans(label, time_s, moments) for label in associations.label]
    gaps_s = [_gaps_s(label, time_s) for label in associations.label]
    mean_gap_s = float(weight @ [gap.mean() if len(gap) else np.nan for gap in gaps_s])
    is_scanned = len(time_s) >= _LEAST_PER_SCAN * len(moments) and all(total > 0 for _, total in scans)
    return StreamCounts(
        int(values[best]), float(probability[best]), int(values[low]), int(values[min(high, len(values) - 1)]),
        _share(clutter, weight), _share(scans, weight) if is_scanned else None, mean_gap_s if np.isfinite(mean_gap_s) else None,
    )  # fmt: skip


def _gaps_s(label: Int64s, time_s: Float64s) -> Float64s:
    agents = np.unique(label[label != CLUTTER])
    return np.concatenate([np.diff(time_s[label == agent]) for agent in agents] + [np.zeros(0)])


def _scans(label: Int64s, time_s: Float64s, moments: Float64s) -> tuple[int, int]:
    """In how many scans agents were detected, of how many, between the first and the last detection of each."""
    seen, total = 0, 0
    for agent in np.unique(label[label != CLUTTER]):
        of_agent = time_s[label == agent]
        num = int(np.searchsorted(moments, of_agent[-1]) - np.searchsorted(moments, of_agent[0])) - 1
        seen, total = seen + max(min(len(of_agent) - 2, num), 0), total + max(num, 0)
    return seen, total


def _share(counted: list[tuple[int, int]], weight: Float64s) -> Share:
    """Of counts (of how many) under each association hypothesis: their own error (Jeffreys' prior), and how they differ."""
    number, total = np.array(counted, dtype=np.float64).T
    mean = (number + 0.5) / (total + 1.0)
    value = float(weight @ mean)
    variance = float(weight @ (mean * (1.0 - mean) / (total + 2.0) + (mean - value) ** 2))
    reach = _NORMAL_95 * float(np.sqrt(variance))
    return Share(value, max(value - reach, 0.0), min(value + reach, 1.0))
