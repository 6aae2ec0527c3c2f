"""What is scored by hindsight: energy scores at detections that were not shown, and the distances that they consist of."""

import dataclasses

import pytest
import torch
from fixtures.bank import as_tracks, random_windows

from cadence.bank.bank import Bank
from cadence.bank.hindsight import at_detections, distances, num_tests, scores_in_hindsight
from cadence.metrics import energy_score
from cadence.types import Detections

WINDOWS = random_windows(num_windows=6)
BANK = Bank().fit(as_tracks(WINDOWS.detections), 1.0)
TIMES = torch.tensor([2.0, 5.0], dtype=torch.float64)


def later(shift_m: float = 0.0) -> Detections:
    """Two detections of every agent after the origin, by where it was seen first."""
    position = WINDOWS.detections.position_m[:, :, :1].expand(-1, -1, 2, -1) + shift_m
    covariance = 0.01 * torch.eye(2, dtype=torch.float64).expand(*position.shape[:3], 2, 2)
    return Detections(TIMES.expand(position.shape[:3]), position, covariance, torch.ones(position.shape[:3], dtype=torch.bool))


def test_only_detections_on_the_grid_are_tests() -> None:
    assert num_tests(WINDOWS, later()) == 24
    assert num_tests(WINDOWS, dataclasses.replace(later(), time_s=later().time_s + 1000.0)) == 0


def test_hypotheses_are_taken_between_the_steps_around_a_detection() -> None:
    drawn = BANK.sample(WINDOWS, 4).position_m
    between = dataclasses.replace(later(), time_s=later().time_s + 0.25)
    foreseen, is_used = at_detections(drawn, WINDOWS, between)
    step = WINDOWS.origin_index + 2
    assert is_used.all()
    torch.testing.assert_close(foreseen[:, :, :, 0], 0.75 * drawn[:, :, :, step] + 0.25 * drawn[:, :, :, step + 1])


def test_scores_are_energy_scores_over_the_age_of_what_was_seen() -> None:
    drawn, unseen = BANK.sample(WINDOWS, 400), later()
    foreseen, _ = at_detections(drawn.position_m, WINDOWS, unseen)
    exact = energy_score(foreseen, drawn.weight, unseen.position_m, is_fair=True)
    seen = WINDOWS.detections
    age_s = unseen.time_s - torch.where(seen.is_observed, seen.time_s, -torch.inf).amax(-1, keepdim=True)
    want = (exact / age_s.clamp_min(WINDOWS.step_s)).mean(-1)[WINDOWS.is_active]
    found = scores_in_hindsight(drawn.position_m, WINDOWS, unseen)
    assert float(found.mean()) == pytest.approx(float(want.mean()), rel=0.05)


def test_distances_of_a_mixture_are_those_of_its_parts() -> None:
    unseen = later()
    first, second = (bank.sample(WINDOWS, 8).position_m for bank in (BANK, dataclasses.replace(BANK, noise_steps=0.5)))
    error, distance = distances([first, second], WINDOWS, unseen)
    torch.testing.assert_close(distance, distance.mT)
    torch.testing.assert_close(error[:, 0] - 0.5 * distance[:, 0, 0], scores_in_hindsight(first, WINDOWS, unseen))
    assert (distance.diagonal(dim1=1, dim2=2) > 0).all()
