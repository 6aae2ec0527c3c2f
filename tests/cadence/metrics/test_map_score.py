"""MapScore against cases computed by hand."""

import math

import pytest
import torch

from cadence.metrics import map_density, map_score, ring_density


def test_first_last_and_random():
    density = torch.arange(100, dtype=torch.float64).expand(3, -1)
    found = map_score(density, torch.tensor([99.0, 0.0, 49.5], dtype=torch.float64))
    # the first cell is tied with itself alone
    assert found.tolist() == [pytest.approx(0.99), pytest.approx(-0.99), pytest.approx(0.0, abs=1e-9)]


def test_where_all_cells_are_alike_the_order_is_random():
    assert map_score(torch.full((1, 50), 0.02), torch.tensor([0.02]))[0] == pytest.approx(0.0, abs=1e-7)


def test_density_is_higher_where_hypotheses_are_and_falls_with_distance():
    generator = torch.Generator().manual_seed(0)
    position_m = torch.randn(2, 40, 2, generator=generator, dtype=torch.float64) * 100.0
    place_m = torch.tensor([[0.0, 0.0], [300.0, 0.0], [3000.0, 0.0], [9000.0, 0.0]], dtype=torch.float64).expand(2, -1, -1)
    density = map_density(position_m, torch.full((2, 40), 1 / 40), place_m, 50.0)
    assert (density.diff(dim=1) < 0).all()


def test_weights_count():
    position_m = torch.tensor([[[0.0, 0.0], [1000.0, 0.0]]])
    density = map_density(position_m, torch.tensor([[0.9, 0.1]]), position_m, 100.0)
    assert density[0, 0] / density[0, 1] == pytest.approx((0.9 + 0.1 / 4) / (0.1 + 0.9 / 4))  # a kernel a kilometre wide
    assert map_density(position_m[:0], torch.zeros(0, 2), position_m[:0], 1.0).shape == (0, 2)


def test_rings_hold_their_shares():
    radii, shares = torch.tensor([[10.0, 20.0]], dtype=torch.float64), torch.tensor([0.5, 0.9])
    density = ring_density(torch.tensor([[5.0, 15.0, 30.0, 50.0]], dtype=torch.float64), radii, shares)[0]
    area = math.pi * torch.tensor([100.0, 300.0, 1200.0])
    torch.testing.assert_close(density[:3] / math.pi * area, torch.tensor([0.5, 0.4, 0.1]).double(), rtol=1e-5, atol=1e-6)
    assert density[3] == 0
