"""Noise schedules and the three parameterisations."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cadence.schedule import MAX_ANGLE, Prediction, clean_from, cosine_schedule, noise_from, target_of

PREDICTIONS: tuple[Prediction, ...] = ("epsilon", "x0", "v")


@pytest.mark.parametrize("num_steps", [10, 100, 1000])
def test_cosine_schedule_is_the_formula(num_steps: int) -> None:
    schedule = cosine_schedule(num_steps)
    level = [math.cos((s / num_steps + 0.008) / 1.008 * math.pi / 2) ** 2 for s in range(num_steps + 1)]
    got = schedule.alpha_bar
    assert len(schedule) == num_steps
    assert got[:-1].tolist() == pytest.approx([value / level[0] for value in level[1:-1]], rel=1e-9)
    assert float(got[-1]) == pytest.approx(1e-3 * float(got[-2]), rel=1e-6)  # the last beta is clipped at 0.999


@given(st.integers(2, 400))
def test_noise_grows_and_never_reaches_pure_noise(num_steps: int) -> None:
    schedule = cosine_schedule(num_steps)
    assert bool((torch.diff(schedule.alpha_bar) < 0).all())
    assert 0.0 < float(schedule.alpha_bar[-1]) and float(schedule.alpha_bar[0]) < 1.0
    assert bool((torch.diff(schedule.angle) > 0).all())
    assert float(schedule.angle[-1]) < MAX_ANGLE


@pytest.mark.parametrize("prediction", PREDICTIONS)
@given(angle=st.floats(0.01, MAX_ANGLE - 0.01), seed=st.integers(0, 99))
def test_a_perfect_answer_gives_the_clean_trajectory_back(prediction: Prediction, angle: float, seed: int) -> None:
    clean, noise = torch.randn(2, 3, 5, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    at = torch.tensor(angle, dtype=torch.float64)
    noisy = torch.cos(at) * clean + torch.sin(at) * noise
    answer = target_of(prediction, clean, noise, at)
    torch.testing.assert_close(clean_from(prediction, answer, noisy, at), clean, rtol=0, atol=1e-9)
    torch.testing.assert_close(noise_from(clean, noisy, at), noise, rtol=0, atol=1e-9)


def test_angles_may_differ_from_row_to_row() -> None:
    clean, noise = torch.randn(2, 4, 5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    angle = torch.linspace(0.2, 1.4, 4, dtype=torch.float64)[:, None, None]
    noisy = torch.cos(angle) * clean + torch.sin(angle) * noise
    for prediction in PREDICTIONS:
        answer = target_of(prediction, clean, noise, angle)
        torch.testing.assert_close(clean_from(prediction, answer, noisy, angle), clean)


def test_velocity_is_the_derivative_in_the_angle() -> None:
    clean, noise = torch.randn(2, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    low, at, high = torch.tensor([0.8 - 1e-5, 0.8, 0.8 + 1e-5], dtype=torch.float64)
    after, before = (torch.cos(a) * clean + torch.sin(a) * noise for a in (high, low))
    torch.testing.assert_close(target_of("v", clean, noise, at), (after - before) / 2e-5, rtol=0, atol=1e-8)


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("angle", [0.0, MAX_ANGLE])
def test_the_ends_of_the_scale_give_no_nan(prediction: Prediction, angle: float) -> None:
    clean, noise = torch.randn(2, 6, generator=torch.Generator().manual_seed(2))
    at = torch.tensor(angle)
    noisy = torch.cos(at) * clean + torch.sin(at) * noise
    assert torch.isfinite(clean_from(prediction, target_of(prediction, clean, noise, at), noisy, at)).all()
    assert torch.isfinite(noise_from(clean, noisy, at)).all()
