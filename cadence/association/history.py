"""How the particles came about: a graph of steps instead of one list of labels a particle.

Association hypotheses that agree on the last few detections of every agent have the same future, whatever they make of what
lies before: they are one particle from then on (combining hypotheses of common recent history; Reid, "An algorithm for tracking
multiple targets", 1979). The graph keeps all of their pasts with their weights, and whole ones are drawn from it backwards.
Copies of labels, of which resampling keeps one after a while, would say of an old doubt that it is settled.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from cadence.arrays import Float64s, Int64s
from cadence.association.types import CLUTTER

_LEAST_SHARE = 1e-4
"""Pasts that make up less of a particle are left out."""
_MOST_LABELS, _BLOCK = 50_000_000, 64
"""Labels that are drawn together, 200 MB; random numbers that are drawn at once for each of them."""


@dataclass(frozen=True, eq=False)
class Step:
    """The E edges from the particles after a detection to those before it.

    child    [E] particle after the detection, ascending
    parent   [E] particle before it
    share    [E] of the child's weight, sums to one over each child
    agent    [E] to whom the detection was given, in the child's numbering of agents, or -1
    renaming [E] row of `names`
    names    [U, A] the child's number of each agent of the parent
    """

    child: Int64s
    parent: Int64s
    share: Float64s
    agent: Int64s
    renaming: Int64s
    names: Int64s

    @cached_property
    def has_one_past(self) -> bool:
        """Whether every particle after the detection came from one before it."""
        return len(self.child) == int(self.child[-1]) + 1

    @cached_property
    def first_edge(self) -> Int64s:
        """Where the edges of each child begin, and where those of the last one end [P + 1]."""
        return np.searchsorted(self.child, np.arange(int(self.child[-1]) + 2))

    @cached_property
    def end(self) -> Float64s:
        """Cumulated shares [E]."""
        return np.cumsum(self.share)

    @cached_property
    def is_renamed(self) -> bool:
        """Whether any child calls an agent otherwise than its parent does."""
        return not bool((self.names == np.arange(self.names.shape[1])).all())

    def drawn_edges(self, particle: Int64s, uniform: Float64s) -> Int64s:
        """An edge for each of M particles after the detection [M], by its share and a number in [0, 1)."""
        if self.has_one_past:
            return particle
        first, last = self.first_edge[particle], self.first_edge[particle + 1]
        wanted = self.end[first] - self.share[first] + uniform
        return np.asarray(np.clip(np.searchsorted(self.end, wanted, "right"), first, last - 1))


def recently(recent: Int64s, agent: Int64s, number: int) -> Int64s:
    """The last detections of every agent [W, A, L], oldest first, -1 for none, when `agent` was given `number`."""
    out = recent.copy()
    rows = np.flatnonzero(agent != CLUTTER)
    out[rows, agent[rows], :-1] = recent[rows, agent[rows], 1:]
    out[rows, agent[rows], -1] = number
    return out


def grouped(recent: Int64s) -> tuple[Int64s, Int64s]:
    """Which of W association hypotheses agree on the last detections of all agents [W, A, L], whatever they call them.

    Returns:
        The group of each hypothesis [W], and its agents by the time of their last detection [W, A]: who is who in a group.
    """
    order = np.argsort(recent[..., -1], axis=1, kind="stable")
    ordered = recent[np.arange(len(recent))[:, None], order].reshape(len(recent), -1)
    return alike(ordered)[1], order


def alike(rows: npt.NDArray[np.integer[Any]]) -> tuple[Int64s, Int64s]:
    """The first of each kind of rows among [W, C], in the order of their bytes, and of which kind each is [W]."""
    if rows.shape[1] == 0:
        return np.zeros(1, dtype=np.int64), np.zeros(len(rows), dtype=np.int64)
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * rows.itemsize)))[:, 0]
    _, first, kind = np.unique(keys, return_index=True, return_inverse=True)
    return first, np.asarray(kind, dtype=np.int64)


def step_of(
    weight: Float64s, parent: Int64s, agent: Int64s, group: Int64s, order: Int64s, child_of_group: Int64s
) -> tuple[Step, Int64s]:
    """The edges of W weighted hypotheses [W] whose groups became children (-1: of no child), and each child's heaviest one."""
    if len(child_of_group) == len(group):  # all differ: each is its own past, under its own names
        member = np.empty_like(group)
        member[group] = np.arange(len(group))
        kept = np.flatnonzero(child_of_group >= 0)
        used = member[kept[np.argsort(child_of_group[kept])]]
        num_agents = order.shape[1]
        zero = np.zeros(len(used), dtype=np.int64)
        return Step(
            np.arange(len(used)), parent[used], np.ones(len(used)), agent[used], zero, np.arange(num_agents)[None]
        ), used
    heaviest_first = np.lexsort((-weight, group))
    first_of_group = heaviest_first[np.searchsorted(group[heaviest_first], np.arange(len(child_of_group)))]
    share = weight / np.bincount(group, weight)[group]
    used = np.flatnonzero(
        (child_of_group[group] >= 0) & ((share >= _LEAST_SHARE) | (first_of_group[group] == np.arange(len(group))))
    )
    used = used[np.argsort(child_of_group[group[used]], kind="stable")]
    name = np.empty((len(used), order.shape[1]), dtype=np.int64)
    name[np.arange(len(used))[:, None], order[used]] = order[first_of_group[group[used]]]
    label = np.where(agent[used] == CLUTTER, CLUTTER, name[np.arange(len(used)), agent[used]])
    child = child_of_group[group[used]]
    first, renaming = alike(name)
    share = share[used] / np.bincount(child, share[used])[child]
    kept = np.flatnonzero(child_of_group >= 0)
    return (
        Step(child, parent[used], share, label, renaming, name[first]),
        first_of_group[kept[np.argsort(child_of_group[kept])]],
    )


@dataclass(frozen=True, eq=False)
class Ending:
    """Particles [M] after the first `num_steps` steps, of each of which one past is wanted, drawn by `generator`."""

    num_steps: int
    particle: Int64s
    generator: np.random.Generator


def drawn_associations(steps: Sequence[Step], endings: Sequence[Ending]) -> list[Int64s]:
    """Labels [M, N] of one association hypothesis for each particle of each ending, drawn from its pasts.

    All go back together, since most of the time goes into taking a step, not into how many take it. What an ending is given
    does not depend on the others.
    """
    found: list[Int64s] = [np.zeros((0, 0), dtype=np.int64)] * len(endings)
    latest_first = sorted(range(len(endings)), key=lambda number: -endings[number].num_steps)
    while latest_first:
        longest = max(endings[latest_first[0]].num_steps, 1)
        num, num_rows = 0, 0
        while num < len(latest_first) and (num == 0 or longest * num_rows < _MOST_LABELS):
            num_rows += len(endings[latest_first[num]].particle)
            num += 1
        part, latest_first = latest_first[:num], latest_first[num:]
        for number, label in zip(part, _drawn_back(steps, [endings[number] for number in part]), strict=True):
            found[number] = label
    return found


def _drawn_back(steps: Sequence[Step], endings: Sequence[Ending]) -> list[Int64s]:
    """Labels of endings that are ordered by their steps, the latest first."""
    num_steps, num_agents = endings[0].num_steps, max((step.names.shape[1] for step in steps), default=0)
    begin = np.cumsum([0, *(len(ending.particle) for ending in endings)])
    label = np.empty((num_steps, begin[-1]), dtype=np.int32)
    particle = np.concatenate([ending.particle for ending in endings])
    uniform = np.empty((begin[-1], _BLOCK))
    name = np.tile(np.append(np.arange(num_agents), CLUTTER), (begin[-1], 1))  # the last is clutter's, whose label is -1
    num_begun = 0
    for number in range(num_steps - 1, -1, -1):
        while num_begun < len(endings) and endings[num_begun].num_steps > number:
            num_begun += 1
        taken = np.array([ending.num_steps - 1 - number for ending in endings[:num_begun]]) % _BLOCK
        for at in np.flatnonzero(taken == 0).tolist():
            rows = slice(begin[at], begin[at + 1])
            uniform[rows] = endings[at].generator.random((_BLOCK, len(endings[at].particle))).T
        step, row = steps[number], np.arange(begin[num_begun])
        chosen = uniform[row, np.repeat(taken, np.diff(begin[: num_begun + 1]))]
        edge = step.drawn_edges(particle[row], chosen)
        label[number, row] = name[row, step.agent[edge]]
        if step.is_renamed:
            width = step.names.shape[1]
            name[row, :width] = np.take_along_axis(name[row, :width], step.names[step.renaming[edge]], axis=1)
        particle[row] = step.parent[edge]
    return [
        np.ascontiguousarray(label[: ending.num_steps, first:last].T, dtype=np.int64)
        for ending, first, last in zip(endings, begin[:-1], begin[1:], strict=True)
    ]
