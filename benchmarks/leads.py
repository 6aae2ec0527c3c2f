"""How far one estimator is ahead of others over several sets of episodes: means of relative leads, cells won, tied and lost."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s
from cadence.metrics import Interval
from pipeline.forecast.scores import HORIZONS, EpisodeScores
from pipeline.forecast.tables import comparison


@dataclass(frozen=True)
class Verdicts:
    """Cells (set, horizon) in which the paired difference's 95 % interval lies below zero, holds it, or lies above it."""

    won: int
    tied: int
    lost: int

    @property
    def total(self) -> int:
        """Cells that were compared."""
        return self.won + self.tied + self.lost


def averaged(parts: Sequence[EpisodeScores]) -> EpisodeScores:
    """Scores averaged over trainings of the same method, which saw the same windows; seconds of one of them."""
    first = parts[0]
    if any(not np.array_equal(part.episode, first.episode) or not np.array_equal(part.count, first.count) for part in parts):
        raise ValueError("averaged: the parts were not scored on the same windows")
    values = {name: np.mean([getattr(part, name) for part in parts], axis=0) for name in ("sums", "shares", "steps")}
    return dataclasses.replace(first, **values, seconds=float(np.mean([part.seconds for part in parts])))


def relative_lead(
    own: Sequence[EpisodeScores],
    rivals: Sequence[Sequence[EpisodeScores]],
    measure: str,
    rival_measure: str,
    horizons: Sequence[int],
    seed: int,
    num_resamples: int = 2000,
) -> Interval:
    """Mean over sets and horizons of 1 - own / best rival, positive where ahead, with a 95 % interval.

    Args:
        own: scores on each set.
        rivals: scores on each set, of each rival; in every cell the one that is better there counts.
        measure: of the own estimator.
        rival_measure: of the rivals.
        horizons: steps out of `HORIZONS`.
        seed: of the bootstrap, in which the episodes of every set are resampled on their own, those of all estimators alike.
        num_resamples: how often.
    """
    index = [HORIZONS.index(step) for step in horizons]
    leads = []
    for number, mine in enumerate(own):
        theirs = [rival[number] for rival in rivals]
        if any(not np.array_equal(mine.episode, other.episode) for other in theirs):
            raise ValueError("relative_lead: a rival was not scored on the same windows")
        times = resampled(len(mine.episode), [seed, 22, number], num_resamples)
        top = times @ mine.measure(measure)[:, index]
        bottom = np.min([times @ other.measure(rival_measure)[:, index] for other in theirs], axis=0)
        leads.append(1.0 - top / bottom)
    mean = np.mean(leads, axis=(0, 2))
    low, high = np.percentile(mean[1:], [2.5, 97.5])
    num_episodes = sum(len(mine.episode) for mine in own)
    return Interval(float(mean[0]), float(low), float(high), len(own) * len(index), num_episodes)


def resampled(num_episodes: int, seed: Sequence[int], num_resamples: int) -> Float64s:
    """How often each episode counts [1 + num_resamples, E]: once in the first row, as often as it is drawn in the others."""
    drawn = np.random.default_rng(list(seed)).integers(num_episodes, size=(num_resamples, num_episodes))
    rows = np.arange(num_resamples)[:, None] * num_episodes
    times = np.bincount((drawn + rows).ravel(), minlength=num_resamples * num_episodes).reshape(num_resamples, num_episodes)
    return np.concatenate([np.ones((1, num_episodes)), times])


def verdicts(
    own: Mapping[str, EpisodeScores], rival: Mapping[str, EpisodeScores], measure: str, rival_measure: str, seed: int,
    num_resamples: int = 2000,
) -> dict[str, list[str]]:  # fmt: skip
    """By set, for every horizon: "won", "tied" or "lost"; sets that one of them lacks are left out."""
    found: dict[str, list[str]] = {}
    for name in own:
        if name in rival:
            pair = {"own": own[name], "rival": rival[name]}
            cells = [comparison("own", "rival", step, pair, seed, num_resamples, measure, rival_measure) for step in HORIZONS]
            found[name] = [
                "won" if cell.difference_high_m < 0 else "lost" if cell.difference_low_m > 0 else "tied" for cell in cells
            ]
    return found


def count(found: Mapping[str, Sequence[str]]) -> Verdicts:
    """All cells together."""
    words = [word for cells in found.values() for word in cells]
    return Verdicts(words.count("won"), words.count("tied"), words.count("lost"))
