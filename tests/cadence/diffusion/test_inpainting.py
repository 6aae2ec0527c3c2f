"""Inpainting: exact where it must be, unchanged where nothing is known, and the smoother against its closed form."""

import math

import pytest
import torch

from cadence.diffusion.inpainting import (
    grid_detections,
    known_cells,
    overwritten,
    overwritten_at_level,
    smoother_correction,
)

EYE = torch.eye(2, dtype=torch.float64)


def detections(at, sigma=0.0, num_steps=24, seed=0, observed=None):
    at = torch.tensor(at, dtype=torch.float64)
    position = torch.randn(*at.shape, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    covariance = sigma**2 * EYE.expand(*at.shape, 2, 2)
    is_observed = torch.ones_like(at, dtype=torch.bool) if observed is None else torch.tensor(observed)
    return grid_detections(at, position, covariance, is_observed, num_steps)


def clean(r, k=3, t=24, seed=5):
    return torch.randn(r, k, t, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_detections_outside_the_grid_are_left_out_and_the_rest_packed():
    found = detections([[-3.0, 2.0, 30.0, 4.5], [1.0, 2.0, 3.0, 4.0]], observed=[[True] * 4, [True, False, True, False]])
    assert found.at.tolist() == [[2.0, 4.5], [1.0, 3.0]]
    assert found.is_used.all()


def test_overwriting_is_exact_at_known_cells_and_nowhere_else():
    found = detections([[0.0, 7.0, 11.4], [3.0, 3.4, -5.0]])
    cells = known_cells(found)
    assert cells.is_known.nonzero().tolist() == [[0, 0], [0, 7], [0, 11], [1, 3]]
    state = clean(2)
    moved = overwritten(state, cells)
    for k in range(3):
        assert torch.equal(moved[0, k, [0, 7, 11]], found.position[0])
        assert torch.equal(moved[1, k, 3], found.position[1, 0])  # the nearer of two
    same = ~cells.is_known[:, None].expand(2, 3, 24)
    assert torch.equal(moved[same], state[same])


def test_overwriting_at_a_level_follows_the_noise():
    cells = known_cells(detections([[4.0]]))
    state, noise = clean(1), clean(1, seed=6)
    assert torch.equal(overwritten_at_level(state, cells, 0.0, noise)[:, :, 4], overwritten(state, cells)[:, :, 4])
    mixed = overwritten_at_level(state, cells, 0.8, noise)
    expected = math.cos(0.8) * cells.position[0, 4] + math.sin(0.8) * noise[0, :, 4]
    torch.testing.assert_close(mixed[0, :, 4], expected)
    assert torch.equal(mixed[:, :, 5:], state[:, :, 5:])


def test_no_detections_leave_everything_as_it_is():
    found = detections([[3.0, 5.0]], observed=[[False, False]])
    state = clean(1)
    correction = smoother_correction(found, dtype=torch.float64)
    assert torch.equal(correction(state), state)
    assert torch.equal(correction(state, torch.ones(1, 3, found.at.shape[1], 2, dtype=torch.float64)), state)
    assert torch.equal(overwritten(state, known_cells(found)), state)
    torch.testing.assert_close(correction.sigma, torch.full_like(correction.sigma, 0.5))


def test_smoother_meets_exact_detections_also_between_steps():
    found = detections([[0.0, 6.25, 7.0, 19.5, 23.0]])
    correction = smoother_correction(found, dtype=torch.float64)
    moved = correction(clean(1))
    there = torch.einsum("rnt,rktd->rknd", correction.observe, moved)
    torch.testing.assert_close(there, found.position[:, None].expand_as(there), atol=1e-5, rtol=0)
    torch.testing.assert_close(0.25 * moved[:, :, 7] + 0.75 * moved[:, :, 6], there[:, :, 1])
    assert correction.sigma[0, 0] < 1e-4 and correction.sigma[0, 13] > 0.1
    # already there: nothing moves
    torch.testing.assert_close(correction(moved), moved, atol=1e-5, rtol=0)


def test_smoother_is_the_closed_form_of_a_gaussian_process():
    """One detection: the gain is k(t, t0) / (k(0) + variance), axis by axis as the covariance says."""
    at = torch.tensor([[5.0]], dtype=torch.float64)
    covariance = torch.diag(torch.tensor([0.04, 1e6], dtype=torch.float64))[None, None]
    position = torch.tensor([[[1.0, 1.0]]], dtype=torch.float64)
    found = grid_detections(at, position, covariance, torch.ones(1, 1, dtype=torch.bool), 24)
    correction = smoother_correction(found, length_steps=4.0, amplitude=0.2, dtype=torch.float64)
    moved = correction(torch.zeros(1, 1, 24, 2, dtype=torch.float64))[0, 0]
    distance = math.sqrt(3) / 4.0 * (torch.arange(24) - 5.0).abs().double()
    expected = 0.04 * (1 + distance) * torch.exp(-distance) / 0.08
    torch.testing.assert_close(moved[:, 0], expected, atol=1e-6, rtol=1e-6)
    assert moved[:, 1].abs().max() < 1e-6


def test_smoother_makes_no_jump_where_overwriting_does():
    found = detections([[12.0]])
    state = torch.zeros(1, 1, 24, 2, dtype=torch.float64)
    length = found.position[0, 0].norm()

    def longest(track):
        return (track[..., 1:, :] - track[..., :-1, :]).norm(dim=-1).max()

    assert longest(overwritten(state, known_cells(found))) == pytest.approx(float(length))
    assert longest(smoother_correction(found, dtype=torch.float64)(state)) < 0.1 * length


def test_noise_spreads_hypotheses_as_the_covariance_says():
    """Matheron's rule: samples of the process, corrected with noise, are samples of its posterior."""
    found = detections([[10.0]], sigma=0.3)
    correction = smoother_correction(found, amplitude=0.5, dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    kernel = torch.linalg.cholesky(_prior(24, 8.0, 0.5))
    num = 40_000
    prior = torch.einsum("ts,ksd->ktd", kernel, torch.randn(num, 24, 2, generator=generator, dtype=torch.float64))
    noise = torch.randn(1, num, 1, 2, generator=generator, dtype=torch.float64)
    posterior = correction(prior[None], noise)[0]
    gain = 0.25 / (0.25 + 0.09)
    torch.testing.assert_close(posterior[:, 10].mean(0), gain * found.position[0, 0], atol=0.01, rtol=0)
    torch.testing.assert_close(posterior.std(dim=0).mean(-1), correction.sigma[0], atol=0.01, rtol=0)
    assert float(correction.sigma[0, 10]) == pytest.approx(math.sqrt(0.25 * (1 - gain)), rel=1e-6)


def test_rows_do_not_depend_on_their_neighbours_padding():
    alone = detections([[3.0, 9.0]])
    both = detections([[3.0, 9.0, 0.0, 0.0], [1.0, 2.0, 3.0, 4.0]], observed=[[True, True, False, False], [True] * 4])
    position = both.position.clone()
    position[0, :2] = alone.position[0]
    both = grid_detections(both.at, position, both.covariance, both.is_used, 24)
    state = clean(2)
    torch.testing.assert_close(
        smoother_correction(both, dtype=torch.float64)(state)[0], smoother_correction(alone, dtype=torch.float64)(state[:1])[0]
    )


def _prior(num_steps, length, amplitude):
    steps = torch.arange(num_steps, dtype=torch.float64)
    distance = math.sqrt(3) / length * (steps[:, None] - steps).abs()
    return amplitude**2 * (1 + distance) * torch.exp(-distance) + 1e-10 * torch.eye(num_steps, dtype=torch.float64)
