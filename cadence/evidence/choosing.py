"""Few weighted hypotheses out of many: as little is drawn by weight as leaves the effective sample size large.

Of M candidates with weights w those that are taken are drawn by w ** s and go on with the weight w ** (1 - s); every share s is
right in expectation. At s = 0 the weights say all; at s = 1 all count the same. The smallest s that
leaves enough of the hypotheses effective keeps the weights telling.
"""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.resampling import effective_number, resample, systematic

_SHARES = tuple(tenth / 10 for tenth in range(11))
ENOUGH = 0.8
"""Of the hypotheses, that are to be effective: weights that leave half of thirty cost two per cent of the energy score."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Which candidate each agent has in each hypothesis [K, A], the weights [K], and the effective sample size [A]."""

    index: Int64s
    weight: Float64s
    num_effective: Float64s


def choose_together(log_weight: Float64s, num: int, uniform: float) -> Choice:
    """Hypotheses whose agents stay together (index [K, 1]).

    Args:
        log_weight: [M] of the candidates, not all minus infinity; `num` or more of them.
        num: how many to take.
        uniform: a random number in [0, 1), which decides all draws.
    """
    weight = _normalised(log_weight)
    if len(weight) == num:
        return Choice(np.arange(num)[:, None], weight, np.array([effective_number(weight)]))
    for share in _SHARES:
        drawn_by = _normalised(share * log_weight if share else np.zeros_like(log_weight))
        index, kept = _taken(drawn_by, num, uniform)
        rest = kept * weight[index] ** (1.0 - share)
        if not rest.any():
            continue
        rest = rest / rest.sum()
        num_effective = _distinct_effective(index, rest)
        if num_effective >= ENOUGH * num:
            break
    return Choice(index[:, None], rest, np.array([num_effective]))


def choose_apart(log_weight: Float64s, num: int, generator: np.random.Generator) -> Choice:
    """Hypotheses put together from tracks of agents that know nothing of each other.

    Each agent's tracks are taken by its own weights and joined at random; what the shares leave over is the weight of the
    joint hypothesis.

    Args:
        log_weight: [M, A] of the candidates, each column not all minus infinity; `num` or more of them.
        num: how many to take.
        generator: of the draws.
    """
    weight = np.stack([_normalised(log_weight[:, agent]) for agent in range(log_weight.shape[1])], axis=1)
    uniform: Float64s = generator.random(size=weight.shape[1:])
    order = np.stack([generator.permutation(num) for _ in range(weight.shape[1])], axis=1)
    for share in _SHARES:
        if share == 0.0 and len(weight) == num:
            index = np.repeat(np.arange(num)[:, None], weight.shape[1], axis=1)
        else:
            drawn_by = weight**share / (weight**share).sum(axis=0)
            taken = [systematic(drawn_by[:, agent], num, float(uniform[agent])) for agent in range(len(uniform))]
            index = np.take_along_axis(np.stack(taken, axis=1), order, axis=0)
        rest = np.prod(np.take_along_axis(weight / weight.max(axis=0), index, axis=0) ** (1.0 - share), axis=1)
        if effective_number(rest) >= ENOUGH * num:
            break
    rest = rest / rest.sum()
    return Choice(index, rest, np.array([_distinct_effective(column, rest) for column in index.T]))


def evened(choice: Choice, uniform: float) -> Choice:
    """The same hypotheses drawn again by weight, so that all count the same; what was drawn twice counts once as effective."""
    num = len(choice.weight)
    index = choice.index[systematic(choice.weight, num, uniform)]
    weight = np.full(num, 1.0 / num)
    return Choice(index, weight, np.array([_distinct_effective(column, weight) for column in index.T]))


def _taken(weight: Float64s, num: int, uniform: float) -> tuple[Int64s, Float64s]:
    """`num` candidates and their weights; no one twice, unless there are too few that count."""
    if np.count_nonzero(weight) < num:
        return systematic(weight, num, uniform), np.full(num, 1.0 / num)
    return resample(weight, num, uniform)


def _normalised(log_weight: Float64s) -> Float64s:
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum(), dtype=np.float64)


def _distinct_effective(index: Int64s, weight: Float64s) -> float:
    """Effective sample size where the same candidate, taken several times, is one."""
    return effective_number(np.bincount(index, weights=weight).astype(np.float64))
