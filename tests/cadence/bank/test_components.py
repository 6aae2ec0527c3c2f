"""Motion models: closed forms against matrix exponentials, the semigroup, limits and units."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from torch import Tensor

from cadence.bank.components import (
    MotionModels,
    concatenate,
    constant_velocity,
    default_models,
    home_ranges,
    ornstein_uhlenbeck,
    transition,
)

rates = st.one_of(st.just(0.0), st.floats(1e-9, 3.0))
turns = st.one_of(st.just(0.0), st.floats(-2.0, 2.0))


def model_of(rate: float, turn: float, diffusion: float = 0.7, speed: float = 1.0) -> MotionModels:
    return MotionModels(*(torch.tensor([value], dtype=torch.float64) for value in (rate, turn, diffusion, speed, math.inf)))


def drift(rate: float, turn: float) -> np.ndarray:
    a = np.zeros((4, 4))
    a[:2, 2:] = np.eye(2)
    a[2:, 2:] = [[-rate, -turn], [turn, -rate]]
    return a


def van_loan(rate: float, turn: float, diffusion: float, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise from one matrix exponential (Van Loan, 1978)."""
    a = drift(rate, turn)
    block = np.zeros((8, 8))
    block[:4, :4], block[4:, 4:] = -a, a.T
    block[2, 6] = block[3, 7] = diffusion
    whole = expm(block * duration)
    matrix = whole[4:, 4:].T
    return matrix, matrix @ whole[:4, 4:]


def transition_of(model: MotionModels, duration: float) -> tuple[Tensor, Tensor]:
    matrix, noise = transition(model, torch.tensor([duration], dtype=torch.float64))
    return matrix[0], noise[0]


def assert_noise_close(got: Tensor, want: Tensor, tolerance: float) -> None:
    scale = want.diagonal().sqrt()
    scale = (scale[:, None] * scale).clamp_min(1e-300)
    assert float(((got - want) / scale).abs().max()) < tolerance


@given(rates, turns, st.floats(0.01, 2.0), st.floats(1e-3, 3.0))
def test_transition_is_the_matrix_exponential(rate: float, turn: float, diffusion: float, duration: float) -> None:
    matrix, noise = transition_of(model_of(rate, turn, diffusion), duration)
    want_matrix, want_noise = van_loan(rate, turn, diffusion, duration)
    np.testing.assert_allclose(matrix.numpy(), want_matrix, rtol=1e-9, atol=1e-9)
    assert_noise_close(noise, torch.from_numpy(want_noise), 1e-7)


@given(rates, turns, st.floats(1e-4, 300.0), st.floats(1e-4, 300.0))
def test_two_durations_in_a_row_are_their_sum(rate: float, turn: float, first: float, second: float) -> None:
    model = model_of(rate, turn)
    f1, q1 = transition_of(model, first)
    f2, q2 = transition_of(model, second)
    f, q = transition_of(model, first + second)
    torch.testing.assert_close(f2 @ f1, f, rtol=1e-9, atol=1e-9 * (first + second))
    assert_noise_close(f2 @ q1 @ f2.mT + q2, q, 1e-8)


@given(rates, turns, st.floats(1e-4, 1e4))
def test_noise_is_symmetric_and_positive(rate: float, turn: float, duration: float) -> None:
    _, noise = transition_of(model_of(rate, turn), duration)
    torch.testing.assert_close(noise, noise.mT, rtol=0, atol=0)
    scale = noise.diagonal().sqrt()
    assert float(torch.linalg.eigvalsh(noise / (scale[:, None] * scale)).min()) > -1e-12


def test_no_time_changes_nothing() -> None:
    models = default_models()
    matrix, noise = transition(models, torch.zeros(len(models), 1, dtype=torch.float64))
    assert torch.equal(matrix, torch.eye(6, dtype=torch.float64).expand_as(matrix))
    assert not noise.any()


def test_constant_velocity_is_the_textbook_matrix() -> None:
    _, noise = transition_of(constant_velocity([0.7]), 3.0)
    pp, pv, vv = 0.7 * 27.0 / 3.0, 0.7 * 9.0 / 2.0, 0.7 * 3.0
    want = torch.tensor([[pp, 0, pv, 0], [0, pp, 0, pv], [pv, 0, vv, 0], [0, pv, 0, vv]], dtype=torch.float64)
    torch.testing.assert_close(noise, want)


@pytest.mark.parametrize("z", [0.02, 0.2])
def test_series_and_closed_form_meet(z: float) -> None:
    inside, outside = (transition_of(model_of(z * share, 0.0), 1.0) for share in (1 - 1e-10, 1 + 1e-10))
    for a, b in zip(inside, outside, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)


@given(st.floats(0.1, 100.0), st.floats(0.01, 5.0), turns, st.floats(1e-3, 1e3))
def test_ornstein_uhlenbeck_keeps_its_stationary_speed(relaxation: float, speed: float, turn: float, duration: float) -> None:
    model = ornstein_uhlenbeck([relaxation], [speed], [turn])
    matrix, noise = transition_of(model, duration)
    velocity, kick = matrix[2:, 2:], noise[2:, 2:]
    torch.testing.assert_close(speed**2 * velocity @ velocity.mT + kick, speed**2 * torch.eye(2, dtype=torch.float64))
    assert float(model.initial_speed[0]) == pytest.approx(speed)


def test_a_full_turn_comes_back_and_a_quarter_turns_left() -> None:
    model = model_of(0.0, 0.25, diffusion=0.0)
    matrix, noise = transition_of(model, 2 * math.pi / 0.25)
    torch.testing.assert_close(matrix, torch.eye(4, dtype=torch.float64), atol=1e-12, rtol=0)
    assert not noise.any()
    quarter, _ = transition_of(model, 0.5 * math.pi / 0.25)
    end = quarter @ torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(end, torch.tensor([4.0, 4.0, 0.0, 1.0], dtype=torch.float64), atol=1e-12, rtol=0)


@given(rates, turns, st.floats(0.01, 50.0), st.floats(0.01, 500.0), st.floats(0.1, 30.0))
def test_units_of_steps_and_metres_agree(rate: float, turn: float, step_s: float, speed_mps: float, steps: float) -> None:
    model = model_of(rate, turn)
    matrix, noise = transition_of(model, steps)
    in_metres, noise_m = transition_of(model.scaled(step_s, speed_mps), steps * step_s)
    unit = torch.tensor([step_s * speed_mps] * 2 + [speed_mps] * 2, dtype=torch.float64)
    torch.testing.assert_close(in_metres, unit[:, None] * matrix / unit, rtol=1e-9, atol=1e-9 * step_s)
    torch.testing.assert_close(noise_m / (unit[:, None] * unit), noise, rtol=1e-8, atol=1e-12)


def test_the_shipped_bank_favours_no_side() -> None:
    models = default_models()
    rows = torch.stack(models.columns, 1)
    mirrored = rows * torch.tensor([1.0, -1.0, 1.0, 1.0, 1.0], dtype=torch.float64)
    assert sorted(rows.tolist()) == sorted(mirrored.tolist())
    assert len({tuple(row) for row in rows.tolist()}) == len(models)


def test_models_are_selected_and_joined() -> None:
    models = concatenate(constant_velocity([1.0, 2.0]), ornstein_uhlenbeck([5.0], [0.5], [0.1]))
    assert len(models) == 3
    picked = models[torch.tensor([2, 0, 0])]
    assert picked.diffusion.tolist() == pytest.approx([0.1, 1.0, 1.0])
    assert picked.turn_rate.tolist() == [0.1, 0.0, 0.0]
    with pytest.raises(ValueError, match="one shape"):
        MotionModels(torch.zeros(2), torch.zeros(3), torch.zeros(2), torch.zeros(2), torch.zeros(2))


def home_of(rate: float, speed: float, size: float) -> MotionModels:
    return home_ranges([1.0 / rate], [speed], [size])


@given(st.floats(0.01, 3.0), st.floats(0.1, 3.0), st.floats(0.3, 30.0), st.floats(1e-3, 30.0))
def test_a_home_is_the_matrix_exponential_about_an_unknown_centre(
    rate: float, speed: float, size: float, duration: float
) -> None:
    matrix, noise = transition_of(home_of(rate, speed, size), duration)
    pull = (speed / size) ** 2
    a = np.kron([[0.0, 1.0, 0.0], [-pull, -rate, pull], [0.0, 0.0, 0.0]], np.eye(2))
    block = np.zeros((12, 12))
    block[:6, :6], block[6:, 6:] = -a, a.T
    block[2, 8] = block[3, 9] = 2.0 * rate * speed**2
    whole = expm(block * duration)
    np.testing.assert_allclose(matrix.numpy(), expm(a * duration), rtol=1e-8, atol=1e-8)
    want = torch.from_numpy(whole[6:, 6:].T @ whole[:6, 6:])
    if duration * max(rate, speed / size) < 12.0:  # beyond, the block's own exponential loses its digits
        assert_noise_close(noise[:4, :4], want[:4, :4], 1e-6)
    assert not noise[4:].any() and not noise[:, 4:].any()


@given(st.floats(0.01, 3.0), st.floats(0.1, 3.0), st.floats(0.3, 30.0), st.floats(1e-3, 300.0))
def test_the_stationary_law_of_a_home_stays(rate: float, speed: float, size: float, duration: float) -> None:
    matrix, noise = transition_of(home_of(rate, speed, size), duration)
    law = torch.diag(torch.tensor([size, size, speed, speed, 0.0, 0.0], dtype=torch.float64) ** 2)
    torch.testing.assert_close(matrix @ law @ matrix.mT + noise, law, rtol=1e-9, atol=1e-9 * size**2)


def test_models_without_a_home_are_the_same_beside_one_with() -> None:
    alone, duration = model_of(0.3, 0.2), torch.tensor([1.5, 1.5], dtype=torch.float64)
    matrix, noise = transition(concatenate(alone, home_of(0.3, 1.0, 3.0)), duration)
    want_matrix, want_noise = transition_of(alone, 1.5)
    assert torch.equal(matrix[0, :4, :4], want_matrix) and torch.equal(noise[0, :4, :4], want_noise)
    assert torch.equal(matrix[0, 4:], torch.eye(6, dtype=torch.float64)[4:])
