"""From a stream of detections to weighted association hypotheses, at every window origin."""

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.association.fitting import fit_habits
from cadence.association.naming import named_like
from cadence.association.particles import Particles, Stream, follow
from cadence.association.presence import Habits
from cadence.association.types import CLUTTER, AssociationConfig, AssociationHypotheses
from cadence.resampling import systematic


def associate(
    time_s: Float64s,
    position_m: Float64s,
    covariance_m2: Float64s,
    origins_s: Float64s,
    config: AssociationConfig,
    seed: int,
    max_speed_mps: float | None = None,
    habits: Habits | None = None,
) -> list[AssociationHypotheses]:
    """What the detections up to each origin may have come from.

    Later detections revise what is said of earlier ones, never the other way round: but for `habits`, which belong to the
    log as a whole as the fitted bank does, nothing after an origin influences its associations. An agent keeps its number from
    origin to origin as long as it keeps most of its detections.

    Args:
        time_s: [N] in any order, seconds from any zero.
        position_m: [N, 2].
        covariance_m2: [N, 2, 2].
        origins_s: [B] in any order; detections at an origin belong to it.
        config: settings.
        seed: of all random numbers.
        max_speed_mps: a speed that no agent exceeds.
        habits: how agents move and are detected; fitted to these detections where None.

    Returns:
        One for each origin, in the order of `origins_s`. Labels are those of the detections up to the origin in order of time
        (a stable sort of `time_s`), so that they are the first ones of the sorted stream.
    """
    order = np.argsort(time_s, kind="stable")
    stream = Stream(*(np.asarray(value, dtype=np.float64)[order] for value in (time_s, position_m, covariance_m2)))
    habits = habits or fit_habits(stream, config, seed, max_speed_mps)
    num_known = np.searchsorted(stream.time_s, origins_s, side="right")
    found = _found_after(stream, habits, config, seed, set(num_known.tolist()))
    num_agents = 1 + max((int(label.max(initial=CLUTTER)) for label, _ in found.values()), default=CLUTTER)
    num_agents = max(num_agents, config.num_agents or 0)
    return [AssociationHypotheses(*found[int(number)], num_agents) for number in num_known]


def _found_after(
    stream: Stream, habits: Habits, config: AssociationConfig, seed: int, wanted: set[int]
) -> dict[int, tuple[Int64s, Float64s]]:
    """Named labels and weights after each wanted number of detections."""
    out: dict[int, tuple[Int64s, Float64s]] = {}
    reference = np.zeros(0, dtype=np.int64)
    for number, particles in enumerate(follow(stream, habits, config.num_particles, seed)):
        if number in wanted:
            label, weight = _drawn(particles, config.num_associations, np.random.default_rng([seed, number]))
            label, weight = _named(label, weight, reference)
            out[number] = label, weight
            reference = label[0]
    return out


def _drawn(particles: Particles, num_associations: int, generator: np.random.Generator) -> tuple[Int64s, Float64s]:
    """Labels and weights of at most so many different association hypotheses that stand for all, without bias."""
    particle = systematic(particles.weight, num_associations, generator.random())
    label, count = np.unique(particles.associations(particle, generator), axis=0, return_counts=True)
    return label, count / num_associations


def _named(label: Int64s, weight: Float64s, reference: Int64s) -> tuple[Int64s, Float64s]:
    """The same hypotheses with common names for their agents; first the one that agrees most with all on who was whose next."""
    before = _predecessors(label)
    best = int(np.argmax([weight @ (before == one).sum(axis=1) for one in before]))
    order = np.argsort(-weight - (np.arange(len(weight)) == best), kind="stable")
    first = named_like(label[best], reference)
    return np.stack([first, *(named_like(one, first) for one in label[order[1:]])]), weight[order]


def _predecessors(label: Int64s) -> Int64s:
    """The detection of the same agent before each one [M, N]: -1 for none, -2 for clutter.

    Hypotheses that differ early by an exchange of two agents agree on most of these later on, which names alone would not tell.
    """
    rows = np.arange(len(label))
    last = np.full((len(label), int(label.max(initial=CLUTTER)) + 2), -1)
    out = np.empty_like(label)
    for number in range(label.shape[1]):
        agent = label[:, number]
        out[:, number] = np.where(agent == CLUTTER, -2, last[rows, agent])
        last[rows, agent] = number
    return out
