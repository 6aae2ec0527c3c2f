"""How fast the targets of a log may be, as its detections let one believe."""

import pytest
import torch

from cadence.bank.plausible import TopSpeed, plausible_speed
from cadence.types import Detections


def steady(speed_mps: float = 10.0, sigma_m: float = 0.0, num: int = 40) -> Detections:
    """One target that goes north; the last detection an hour later, somewhere else."""
    time_s = torch.cat([torch.arange(num - 1).double(), torch.tensor([3600.0 + num]).double()])
    place = torch.stack([torch.zeros(num).double(), speed_mps * time_s], dim=-1)
    place[-1] = torch.tensor([9e6, 0.0])
    covariance = sigma_m**2 * torch.eye(2, dtype=torch.float64).expand(1, 1, num, 2, 2)
    return Detections(time_s[None, None], place[None, None], covariance, torch.ones(1, 1, num, dtype=torch.bool))


def test_a_steady_target_may_be_a_quarter_faster() -> None:
    assert plausible_speed(steady(), 1.0) == pytest.approx(12.5)
    assert plausible_speed(steady(num=3), 4.0) == pytest.approx(12.5)  # of detections within a step, too


def test_a_short_dash_within_a_step_counts() -> None:
    one = steady()
    one.position_m[0, 0, 20:, 1] += 8.0
    assert plausible_speed(one, 4.0) == pytest.approx(1.25 * 18.0)


def test_noise_is_not_speed() -> None:
    """Two detections with 3 m each are sqrt(18) m in doubt: those eight seconds apart tell most."""
    assert plausible_speed(steady(sigma_m=3.0), 1.0) == pytest.approx(1.25 * (10.0 - 18.0**0.5 / 8.0))
    assert plausible_speed(steady(sigma_m=300.0), 1.0) is None


def test_a_false_detection_is_no_speed() -> None:
    one = steady()
    one.position_m[0, 0, 20] += 9e4
    assert plausible_speed(one, 1.0) == pytest.approx(12.5)


def test_top_speeds_of_hypotheses_are_spread_about_what_was_seen() -> None:
    found = TopSpeed(10.0)
    spread = found.spread(200)
    assert spread.min() >= 10.0 and spread.max() <= found.limit_mps
    assert spread.mean() == pytest.approx(11.25, abs=0.03)
    assert spread[:10].std() == pytest.approx(float(spread.std()), rel=0.15)


def test_padding_long_gaps_and_single_detections_tell_nothing() -> None:
    one = steady()[torch.tensor([0])]
    alone = Detections(one.time_s, one.position_m, one.covariance_m2, torch.arange(40).expand(1, 1, 40) < 1)
    assert plausible_speed(alone, 1.0) is None
    apart = Detections(100.0 * one.time_s, one.position_m, one.covariance_m2, one.is_observed)
    assert plausible_speed(apart, 1.0) is None
