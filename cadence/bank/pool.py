"""A pool of estimators: hypotheses shared out among them so that they foresee best what none of them was shown.

A linear opinion pool (Thorey, Mallet, Baudin, "Online learning with the CRPS for ensemble forecasting", 2017): the energy score
of a mixture is quadratic in its weights, so that the best ones follow from each member's distances to what was withheld, and to
each other, with every member drawn once.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.bank import Bank, BankPosterior, model_evidence
from cadence.bank.hindsight import LEAST_TESTS, Test, distances, num_tests
from cadence.bank.rows import active_rows, scatter_hypotheses
from cadence.types import Detections, HypothesisSet, WindowBatch

NUM_DRAWN = 8
"""Hypotheses of each member a test: many tests with few tell more than few tests with many, for the same work."""
_NUM_ROUNDS = 300
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_NOISE_STEPS = 0.02
_TEMPER = 0.3
_FORGETS = 0.5
"""Per step: a track whose velocity is forgotten faster wanders like a random walk."""
_LEAST_WEIGHT = 0.02
SETTINGS = ("exact", "noisy", "home", "wandering", "doubted")
"""Names of `settings_of`."""
_SAFE = torch.tensor([0.25, 0.25, 0.0, 0.0, 0.5], dtype=torch.float64)
"""A mixture is never worse than the mean of its members, as energy scores are convex."""


@dataclass(frozen=True, eq=False)
class BankPool:
    """Banks fitted to one log, and their weights [M] up to the last detection and after it.

    Each draws its share of the hypotheses of a window; where past and future come from two members, they meet at the last
    detection, which both pass.
    """

    members: tuple[Bank, ...]
    weight_past: Tensor
    weight_future: Tensor
    name: str = "bank"

    def fit(self, tracks: Detections, step_s: float | None = None) -> "BankPool":
        """The members fitted to a log's detections, with the same weights."""
        return dataclasses.replace(self, members=tuple(member.fit(tracks, step_s) for member in self.members))

    def posterior(self, windows: WindowBatch, num_hypotheses: int) -> BankPosterior:
        """Moments of the mixture and joint samples, rows as for `Bank.posterior`."""
        rows, _ = active_rows(windows)
        last_s = torch.where(rows.is_observed, rows.time_s, -torch.inf).amax(1) if len(rows.time_s) else rows.time_s[:, 0]
        is_after = windows.time_s.double() > last_s[:, None]
        past, future = (shared_out(weight, num_hypotheses) for weight in (self.weight_past, self.weight_future))
        sample = torch.zeros(*is_after.shape[:1], num_hypotheses, windows.num_steps, 2, dtype=torch.float64)
        first = torch.zeros(*is_after.shape, 2, dtype=torch.float64)
        second = torch.zeros(is_after.shape, dtype=torch.float64)
        drawn = [index for index in range(len(self.members)) if bool(((past == index) | (future == index)).any())]
        evidence = dict(zip(drawn, _evidence([self.members[index] for index in drawn], windows), strict=True))
        for index in drawn:
            bank, is_drawn = self.members[index], (past == index) | (future == index)
            part = bank.posterior(windows, int(is_drawn.sum()), evidence[index])
            is_own = torch.where(is_after[:, None], (future[is_drawn] == index)[:, None], (past[is_drawn] == index)[:, None])
            sample[:, is_drawn] = torch.where(is_own[..., None], part.sample_m, sample[:, is_drawn])
            share = torch.where(is_after, (future == index).double().mean(), (past == index).double().mean())
            first += share[..., None] * part.mean_m
            second += share * (2.0 * part.sigma_m**2 + (part.mean_m**2).sum(-1))
        variance = 0.5 * (second - (first**2).sum(-1))
        return BankPosterior(first, variance.clamp_min(0.0).sqrt(), sample)

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint samples of the pool."""
        return scatter_hypotheses(self.posterior(windows, num_hypotheses).sample_m, windows)

    def about(self) -> dict[str, object]:
        """What a summary says of it: the bank, and the shares of its settings up to the last detection and after it."""
        shares = (dict(zip(SETTINGS, weight.tolist(), strict=False)) for weight in (self.weight_past, self.weight_future))
        return {**self.members[0].about(), **dict(zip(("past", "future"), shares, strict=True))}

    def length_m(self, step_s: float) -> float:
        """One step length: the way at the log's typical speed in a step."""
        return self.members[0].length_m(step_s)


def settings_of(bank: Bank) -> tuple[Bank, ...]:
    """The bank, and what else may hold: detections less exact, a home for all, no memory of the way, likelihood misleads."""
    forgets = ~bank.models.has_home & (bank.models.relaxation_rate > _FORGETS)
    return (
        bank,
        dataclasses.replace(bank.near, noise_steps=_NOISE_STEPS),
        bank.only(bank.models.has_home),
        dataclasses.replace(bank.near.only(forgets), noise_steps=_NOISE_STEPS),
        dataclasses.replace(bank.near, noise_steps=_NOISE_STEPS, temper=_TEMPER),
    )


def pool_by_hindsight(bank: Bank, past: Test, future: Test | None) -> BankPool:
    """The bank's settings pooled by how they fill gaps, and by how they go on; safe weights where too little can be tested.

    Without a `future` nothing is drawn after the last detection, and nothing tested.
    """
    members = settings_of(bank)
    if bank.log_weight is None:
        return BankPool(members[:1], torch.ones(1).double(), torch.ones(1).double())
    # Gaps are filled whatever happens after the last detection, and there is nothing to test.
    fixed = [dataclasses.replace(member, switch_rate=0.0) for member in members]
    weight_past = best_weights(_found(fixed, _up_to_origin(past[0]), past[1]), _SAFE)
    return BankPool(members, weight_past, best_weights(None if future is None else _found(members, *future), _SAFE))


def pool_as_told(bank: Bank, about: Mapping[str, object]) -> BankPool | None:
    """A fitted bank's settings pooled as what `BankPool.about` said of them before; None where that is of other settings."""
    members = settings_of(bank) if bank.log_weight is not None else (bank,)
    weights, names = [], SETTINGS[: len(members)]
    for part in ("past", "future"):
        shares = about.get(part)
        if not isinstance(shares, dict) or set(shares) != set(names):
            return None
        weights.append(torch.tensor([shares[name] for name in names], dtype=torch.float64))
    return BankPool(members, weights[0], weights[1])


def _up_to_origin(windows: WindowBatch) -> WindowBatch:
    return dataclasses.replace(windows, time_s=windows.time_s[: windows.origin_index + 1])


def _found(members: Sequence[Bank], windows: WindowBatch, unseen: Detections) -> tuple[Tensor, Tensor] | None:
    """Distances of what the members draw to what the windows do not hold; None where that is too little."""
    if not windows.num_windows or num_tests(windows, unseen) < LEAST_TESTS:
        return None
    evidence = _evidence(members, windows)
    drawn = [member.sample(windows, NUM_DRAWN, said).position_m for member, said in zip(members, evidence, strict=True)]
    return distances(drawn, windows, unseen)


def _evidence(members: Sequence[Bank], windows: WindowBatch) -> list[Tensor]:
    """What each member's models make of the detections; members that weigh the same models differently ask but once."""
    found: list[Tensor] = []
    for number, member in enumerate(members):
        alike = (other for other in range(number) if _asks_alike(member, members[other]))
        other = next(alike, None)
        found.append(model_evidence(member, windows) if other is None else found[other])
    return found


def _asks_alike(one: Bank, other: Bank) -> bool:
    return one.models is other.models and all(
        getattr(one, name) == getattr(other, name) for name in ("noise_steps", "spacing_steps", "speed_mps")
    )


def best_weights(found: tuple[Tensor, Tensor] | None, safe: Tensor) -> Tensor:
    """Weights [M] of least energy score on a test, shrunk towards safe ones by what the test leaves uncertain.

    Args:
        found: `distances` of the members; None where nothing could be tested.
        safe: weights [M] where nothing is known.
    """
    if found is None:
        return safe
    error, distance = found
    best = _least(error.sum(0), distance.sum(0))
    gain = _scores(safe, error, distance) - _scores(best, error, distance)
    signal, noise = float(gain.sum()) ** 2, float(gain.var(correction=0)) * len(gain)
    weight = safe + signal / max(signal + noise, 1e-300) * (best - safe)
    weight = torch.where(weight < _LEAST_WEIGHT, 0.0, weight)
    return weight / weight.sum()


def shared_out(weight: Tensor, num_hypotheses: int) -> Tensor:
    """Which member draws each hypothesis [K]: any first ones of them hold about its share of each member."""
    place = (0.5 + _GOLDEN * torch.arange(num_hypotheses, dtype=torch.float64)) % 1.0
    return torch.searchsorted(weight.cumsum(0).clamp(max=1.0), place, right=True).clamp(max=len(weight) - 1)


def _scores(weight: Tensor, error: Tensor, distance: Tensor) -> Tensor:
    """Energy scores [R] of the mixture with weights [M]."""
    scores: Tensor = error @ weight - 0.5 * torch.einsum("m,rmn,n->r", weight, distance, weight)
    return scores


def _least(error: Tensor, distance: Tensor) -> Tensor:
    """Weights of least energy score by exponentiated gradient, which stays on the simplex."""
    weight = torch.full_like(error, 1.0 / len(error))
    rate = 2.0 / float(distance.abs().max().clamp_min(1e-12))
    for _ in range(_NUM_ROUNDS):
        weight = torch.softmax(weight.log() - rate * (error - distance @ weight), 0).clamp_min(1e-12)
    return weight / weight.sum()
