"""From a stream of detections to weighted association hypotheses, at every window origin."""

from collections.abc import Callable

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.association.fitting import fit_habits
from cadence.association.history import Ending, alike, drawn_associations
from cadence.association.naming import named_like
from cadence.association.particles import Stream, follow
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
    on_step: Callable[[], object] = int,
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
        on_step: hears of every detection that is followed.

    Returns:
        One for each origin, in the order of `origins_s`. Labels are those of the detections up to the origin in order of time
        (a stable sort of `time_s`), so that they are the first ones of the sorted stream.
    """
    order = np.argsort(time_s, kind="stable")
    stream = Stream(*(np.asarray(value, dtype=np.float64)[order] for value in (time_s, position_m, covariance_m2)))
    habits = habits or fit_habits(stream, config, seed, max_speed_mps)
    num_known = np.searchsorted(stream.time_s, origins_s, side="right")
    found = _found_after(stream, habits, config, seed, set(num_known.tolist()), on_step)
    num_agents = 1 + max((int(label.max(initial=CLUTTER)) for label, _ in found.values()), default=CLUTTER)
    num_agents = max(num_agents, config.num_agents or 0)
    return [AssociationHypotheses(*found[int(number)], num_agents) for number in num_known]


def _found_after(
    stream: Stream, habits: Habits, config: AssociationConfig, seed: int, wanted: set[int], on_step: Callable[[], object]
) -> dict[int, tuple[Int64s, Float64s]]:
    """Named labels and weights after each wanted number of detections."""
    endings, particles = [], None
    for number, particles in enumerate(follow(stream, habits, config.num_particles, seed)):
        if number in wanted:
            generator = np.random.default_rng([seed, number])
            # evenly by weight: hypotheses that stand for all, without bias
            particle = systematic(particles.weight, config.num_associations, generator.random())
            endings.append(Ending(number, particle, generator))
        if number > 0:
            on_step()
    assert particles is not None
    out: dict[int, tuple[Int64s, Float64s]] = {}
    reference = np.zeros(0, dtype=np.int64)
    for ending, drawn in zip(endings, drawn_associations(particles.steps, endings), strict=True):
        first, kind = alike((drawn - CLUTTER).astype(">u4"))  # big-endian bytes are in the order of the numbers
        label, weight = _named(drawn[first], np.bincount(kind) / config.num_associations, reference)
        out[ending.num_steps] = label, weight
        reference = label[0]
    return out


def _named(label: Int64s, weight: Float64s, reference: Int64s) -> tuple[Int64s, Float64s]:
    """The same hypotheses with common names for their agents; first the one that agrees most with all on who was whose next."""
    before = _predecessors(label)
    is_common = (before == before[0]).all(axis=0)
    doubtful = before[:, ~is_common]
    agreed = [int(is_common.sum()) + (doubtful == one).sum(axis=1) for one in doubtful]
    best = int(np.argmax([weight @ number for number in agreed]))
    order = np.argsort(-weight - (np.arange(len(weight)) == best), kind="stable")
    first = named_like(label[best], reference)
    return np.stack([first, *(named_like(one, first) for one in label[order[1:]])]), weight[order]


def _predecessors(label: Int64s) -> Int64s:
    """The detection of the same agent before each one [M, N]: -1 for none, -2 for clutter.

    Hypotheses that differ early by an exchange of two agents agree on most of these later on, which names alone would not tell.
    """
    order = np.argsort(label, axis=1, kind="stable")
    agent = np.take_along_axis(label, order, axis=1)
    before = np.full_like(label, -1)
    before[:, 1:] = np.where(agent[:, 1:] == agent[:, :-1], order[:, :-1], -1)
    out = np.empty_like(label)
    np.put_along_axis(out, order, before, axis=1)
    return np.where(label == CLUTTER, -2, out)
