"""Choice by hindsight: what is scored, what wins, and when nothing is chosen."""

import dataclasses

import pytest
import torch
from fixtures.bank import as_tracks, random_windows, simulate

from cadence.bank.bank import Bank
from cadence.bank.components import ornstein_uhlenbeck
from cadence.bank.hindsight import candidates, choose_by_hindsight
from cadence.types import Detections, WindowBatch

WINDOWS = random_windows(num_windows=6)
BANK = Bank().fit(as_tracks(WINDOWS.detections), 1.0)


def later_at(position_m: torch.Tensor, time_s: torch.Tensor) -> Detections:
    """Detections of every agent at some times after the origin: position [B, A, N, 2]."""
    shape = tuple(position_m.shape[:3])
    covariance = 0.01 * torch.eye(2, dtype=torch.float64).expand(*shape, 2, 2)
    return Detections(time_s.expand(shape), position_m, covariance, torch.ones(shape, dtype=torch.bool))


def test_candidates_differ_in_how_models_go_on() -> None:
    often, rarely, single = candidates(BANK)
    assert often.switch_rate > rarely.switch_rate > single.switch_rate == 0.0
    assert single.log_weight is not None
    assert single.log_weight.exp().tolist() == [0.0] * (len(BANK.models) - 1) + [1.0]
    assert torch.isfinite(single.sample(WINDOWS, 2).position_m).all()


def test_nothing_is_chosen_without_evidence() -> None:
    times = torch.tensor([2.0], dtype=torch.float64)
    here = WINDOWS.detections.position_m[:, :, :1]
    few = later_at(here, times)
    few = dataclasses.replace(few, is_observed=torch.arange(12).view(6, 2, 1) < 7)
    assert choose_by_hindsight(BANK, WINDOWS, few) is BANK
    beyond = later_at(here, times + 1000.0)
    assert choose_by_hindsight(BANK, WINDOWS, beyond) is BANK
    unfitted = Bank(speed_mps=1.0)
    assert choose_by_hindsight(unfitted, WINDOWS, later_at(here, times)) is unfitted


def energy_score(bank: Bank, position_m: torch.Tensor, times: torch.Tensor) -> float:
    """Energy score at grid steps from all pairs of many samples, divided by the age of the last detection."""
    d = WINDOWS.detections
    last = torch.where(d.is_observed, d.time_s, -torch.inf).amax(-1, keepdim=True)
    sample = bank.sample(WINDOWS, 60).position_m[:, :, :, WINDOWS.origin_index + times.long()]
    error = (sample - position_m[:, None]).norm(dim=-1).mean(1)
    spread = (sample[:, :, None] - sample[:, None]).norm(dim=-1).sum((1, 2)) / (60 * 59)
    return float(((error - 0.5 * spread) / (times - last)).mean())


@pytest.mark.parametrize("reach", [0.0, 1.0, 4.0])
def test_the_candidate_with_the_least_energy_score_wins(reach: float) -> None:
    times = torch.tensor([4.0, 8.0, 12.0], dtype=torch.float64)
    forecast = candidates(BANK)[2].posterior(WINDOWS, 1).mean_m[:, WINDOWS.origin_index + times.long()]
    noise = torch.randn(forecast.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    position = (forecast + reach * noise).view(6, 2, 3, 2)
    scores = {candidate.switch_rate: energy_score(candidate, position, times) for candidate in candidates(BANK)}
    chosen = choose_by_hindsight(BANK, WINDOWS, later_at(position, times)).switch_rate
    # it scores 24 samples, half against half: the best one, or one as good within that noise
    spread = max(scores.values()) - min(scores.values())
    assert scores[chosen] <= min(scores.values()) + 0.25 * spread + 0.005


def test_targets_of_one_model_choose_that_model_or_rare_changes() -> None:
    true = ornstein_uhlenbeck([4.0], [0.8], [0.0])
    times = torch.arange(20, dtype=torch.float64) * 2.0
    tracks = simulate(true, times, 0.02, 40, 3)
    past = Detections(*(getattr(tracks, f.name)[:, :, :14] for f in dataclasses.fields(Detections)))
    later = Detections(*(getattr(tracks, f.name)[:, :, 14:] for f in dataclasses.fields(Detections)))
    windows = WindowBatch(
        torch.arange(-27.0, 13.0, dtype=torch.float64),
        dataclasses.replace(past, time_s=past.time_s - 26.0),
        torch.arange(40),
        27,
    )
    bank = Bank().fit(past, 1.0)
    after = dataclasses.replace(later, time_s=later.time_s - 26.0)
    chosen, again = (choose_by_hindsight(bank, windows, after) for _ in range(2))
    assert chosen.switch_rate == again.switch_rate < candidates(bank)[0].switch_rate
