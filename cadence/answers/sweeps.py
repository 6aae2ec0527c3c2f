"""How much of where an agent may have been the looks swept that did not see it, and where the next would have paid most.

The words are those of search theory (Koopman, "Search and Screening", 1946; Stone, "Theory of Optimal Search", 1975): looks of
P(detect) p find a story with probability 1 - prod (1 - p), and the mean over the stories is the cumulative probability of
success. What is left of a story's weight, w prod (1 - p), is by Bayes how likely it is after the looks saw nothing. Looks are
not independent: as in `cadence.evidence.silence`, an exponent below one says how much less they tell.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cadence.answers.estimates import Probability, wilson
from cadence.arrays import Float64s
from cadence.evidence.silence import Looks, Silence
from cadence.resampling import effective_number
from cadence.stories import Stories
from cadence.types import Tracks

NUM_TIMES = 20
"""Moments at which the cumulative probability is told."""
_MOST_PLACES = 400


@dataclass(frozen=True, eq=False)
class NextLook:
    """Where one more look at the end of the time would have detected most likely, by which kind of looks, and how likely."""

    place_m: tuple[float, float]
    kind: int
    success: float


@dataclass(frozen=True, eq=False)
class Sweep:
    """What looks made of one agent's whereabouts.

    success     probability that the looks which did not see it would have, with its Monte Carlo error
    time_s      [N] moments, success_by [N] the same up to each of them
    num_looks   of them within the time
    next_look   None where the agent is nowhere at the end, or no look could add anything
    """

    success: Probability
    time_s: Float64s
    success_by: Float64s
    num_looks: int
    next_look: NextLook | None


def swept(stories: Stories, agent: int, looks: Sequence[Silence], span_s: tuple[float, float]) -> Sweep:
    """What the looks within a time say of an agent.

    Args:
        stories: of the mission; weights sum to one.
        agent: its number.
        looks: of sensors that share obstacles, with the exponent that counts; those that saw the agent are left out.
        span_s: from when to when, on the stories' clock.

    Raises:
        ValueError: where the agent is in no story within the time.
    """
    edges_s = np.linspace(*span_s, NUM_TIMES + 1)
    missed = np.zeros((stories.num_hypotheses, NUM_TIMES))
    is_there = np.zeros(stories.num_hypotheses, dtype=bool)
    # a look at the border of two pieces belongs to the later one
    ends_s = np.append(np.nextafter(edges_s[1:-1], -np.inf), edges_s[-1])
    for piece, (from_s, to_s) in enumerate(zip(edges_s[:-1].tolist(), ends_s.tolist(), strict=True)):
        tracks = _piece(stories, agent, from_s, to_s)
        is_there |= tracks.position_m[0, :, 0, :, 0].isfinite().any(-1).numpy()
        for silence in looks:
            missed[:, piece] += silence.log_likelihood(tracks)[0, :, 0].numpy()
    if not is_there.any():
        raise ValueError(f"swept: {stories.agent_ids[agent]} is in no story between {span_s[0]:g} and {span_s[1]:g} s")
    weight = np.where(is_there, stories.weight, 0.0)
    weight = weight / weight.sum()
    found = 1.0 - np.exp(np.cumsum(missed, axis=1))
    by = weight @ found
    # what lies between 0 and 1 varies less than what is one of the two: the interval is rather too wide
    num = effective_number(weight)
    success = Probability(float(by[-1]), *wilson(float(by[-1]), num), num)
    name = stories.agent_ids[agent]
    is_silent = [each.is_silent(name) & (each.time_s >= span_s[0]) & (each.time_s <= span_s[1]) for each in _kinds(looks)]
    left = weight * np.exp(missed.sum(axis=1))
    next_look = _next_look(stories.at(np.array([span_s[1]]))[:, agent, 0], left / max(left.sum(), 1e-300), looks)
    return Sweep(success, edges_s[1:], by, sum(int(some.sum()) for some in is_silent), next_look)


def _piece(stories: Stories, agent: int, from_s: float, to_s: float) -> Tracks:
    """The stories of an agent between two moments: their steps, and both ends."""
    inner = stories.time_s[(stories.time_s > from_s) & (stories.time_s < to_s)]
    time_s = np.concatenate([[from_s], inner, [to_s]])
    position_m = stories.of([agent]).at(time_s)
    return Tracks(torch.from_numpy(position_m)[None], torch.from_numpy(time_s)[None], (stories.agent_ids[agent],))


def _kinds(looks: Sequence[Silence]) -> list[Looks]:
    return [each for part in looks for each in part.looks]


def _next_look(position_m: Float64s, left: Float64s, looks: Sequence[Silence]) -> NextLook | None:
    """The place of a story from which a look all around would detect most likely.

    Args:
        position_m: [K, 2] where the stories are.
        left: [K] how likely each is after the looks that saw nothing.
        looks: whose curves may be used; the kinds are numbered through.
    """
    is_there = np.isfinite(position_m).all(axis=1)
    position_m, left = position_m[is_there], left[is_there]
    places = position_m[np.argsort(-left, kind="stable")[:_MOST_PLACES]]
    if not len(places):
        return None
    distance_m = np.hypot(*np.moveaxis(position_m[:, None] - places[None], -1, 0))
    best: NextLook | None = None
    for kind, each in enumerate(_kinds(looks)):
        chance = left @ each.curve(distance_m / max(float(np.median(each.range_m)), 1e-12))
        at = int(chance.argmax())
        if chance[at] > (0.0 if best is None else best.success):
            best = NextLook((float(places[at, 0]), float(places[at, 1])), kind, float(chance[at]))
    return best
