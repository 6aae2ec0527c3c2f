"""Names of agents that hold over all association hypotheses of a log and over all window origins.

Every hypothesis numbers its agents as it meets them. Here they get the names of agents of one that was named before, matched
by the detections that both give to them (the assignment of greatest overlap). The last ones count most: of two that part
early, by an exchange of two agents, names are to say who is where now.
"""

import numpy as np
from scipy.optimize import linear_sum_assignment

from cadence.arrays import Int64s
from cadence.association.types import CLUTTER

_FORGETTING = 0.8
"""What a detection counts, to the power of how many later ones of the same agent there are, in either hypothesis."""


def named_like(label: Int64s, reference: Int64s) -> Int64s:
    """The labels [N] renamed after a reference [N'] for the first N' detections; agents without overlap get free names.

    Free names are the smallest that no agent of this hypothesis has got, so that as few as possible are used in all.
    """
    num_own = int(label.max(initial=CLUTTER)) + 1
    num_other = int(reference.max(initial=CLUTTER)) + 1
    both = label[: len(reference)]
    is_pair = (both != CLUTTER) & (reference != CLUTTER)
    index = both[is_pair] * num_other + reference[is_pair]
    counts = _FORGETTING ** (_num_later(both) + _num_later(reference))[is_pair]
    overlap = np.bincount(index, counts, minlength=num_own * num_other).reshape(num_own, num_other)
    name = np.full(num_own + 1, CLUTTER)  # the last entry answers for clutter
    rows, columns = linear_sum_assignment(-overlap)
    is_match = overlap[rows, columns] > 0
    name[rows[is_match]] = columns[is_match]
    nameless = np.flatnonzero(name[:-1] == CLUTTER)
    is_free = np.ones(num_own + num_other, dtype=np.bool_)
    is_free[name[name != CLUTTER]] = False
    name[nameless] = np.flatnonzero(is_free)[: len(nameless)]
    return np.asarray(name[label], dtype=np.int64)


def _num_later(label: Int64s) -> Int64s:
    """How many later detections [N] have the same label."""
    order = np.argsort(label[::-1], kind="stable")
    grouped = label[::-1][order]
    later = np.empty_like(label)
    later[order] = np.arange(len(label)) - np.searchsorted(grouped, grouped)
    return later[::-1]
