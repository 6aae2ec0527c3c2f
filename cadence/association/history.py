"""How the particles came about: a graph of steps instead of one list of labels a particle.

Association hypotheses that agree on the last few detections of every agent have the same future, whatever they make of what
lies before: they are one particle from then on (combining hypotheses of common recent history; Reid, "An algorithm for tracking
multiple targets", 1979). The graph keeps all of their pasts with their weights, and whole ones are drawn from it backwards.
Copies of labels, of which resampling keeps one after a while, would say of an old doubt that it is settled.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.association.types import CLUTTER

_LEAST_SHARE = 1e-4
"""Pasts that make up less of a particle are left out."""


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
    ordered = np.ascontiguousarray(np.take_along_axis(recent, order[..., None], axis=1).reshape(len(recent), -1))
    keys = ordered.view(np.dtype((np.void, ordered.shape[1] * ordered.itemsize)))[:, 0]
    return np.asarray(np.unique(keys, return_inverse=True)[1], dtype=np.int64), order


def step_of(
    weight: Float64s, parent: Int64s, agent: Int64s, group: Int64s, order: Int64s, child_of_group: Int64s
) -> tuple[Step, Int64s]:
    """The edges of W weighted hypotheses [W] whose groups became children (-1: of no child), and each child's heaviest one."""
    heaviest_first = np.lexsort((-weight, group))
    first_of_group = heaviest_first[np.searchsorted(group[heaviest_first], np.arange(len(child_of_group)))]
    share = weight / np.bincount(group, weight)[group]
    used = np.flatnonzero(
        (child_of_group[group] >= 0) & ((share >= _LEAST_SHARE) | (first_of_group[group] == np.arange(len(group))))
    )
    used = used[np.argsort(child_of_group[group[used]], kind="stable")]
    name = np.empty((len(used), order.shape[1]), dtype=np.int64)
    np.put_along_axis(name, order[used], order[first_of_group[group[used]]], axis=1)
    label = np.where(agent[used] == CLUTTER, CLUTTER, name[np.arange(len(used)), agent[used]])
    child = child_of_group[group[used]]
    names, renaming = np.unique(name, axis=0, return_inverse=True)
    share = share[used] / np.bincount(child, share[used])[child]
    kept = np.flatnonzero(child_of_group >= 0)
    return (
        Step(child, parent[used], share, label, renaming, names),
        first_of_group[kept[np.argsort(child_of_group[kept])]],
    )


def drawn_associations(steps: Sequence[Step], particle: Int64s, generator: np.random.Generator) -> Int64s:
    """Labels [M, N] of one association hypothesis for each of M particles after the last step, drawn from its pasts."""
    rows = np.arange(len(particle))
    label = np.empty((len(particle), len(steps)), dtype=np.int64)
    num_agents = max((step.names.shape[1] for step in steps), default=0)
    name = np.broadcast_to(np.arange(num_agents), (len(particle), num_agents))
    for number, step in zip(range(len(steps) - 1, -1, -1), reversed(steps), strict=True):
        end = np.cumsum(step.share)
        first, last = (np.searchsorted(step.child, particle, side) for side in ("left", "right"))
        wanted = end[first] - step.share[first] + generator.random(len(particle))
        edge = np.clip(np.searchsorted(end, wanted, "right"), first, last - 1)
        agent = step.agent[edge]
        label[:, number] = np.where(agent == CLUTTER, CLUTTER, name[rows, agent])
        name = np.take_along_axis(name, step.names[step.renaming[edge]], axis=1)
        particle = step.parent[edge]
    return label
