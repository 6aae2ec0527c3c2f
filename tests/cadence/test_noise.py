"""Random starts that keep apart: the law of one, and what pairs and directions have to be."""

import torch

from cadence.diffusion.noise import RowNoise


def test_spread_draws_are_opposite_orthogonal_and_standard_normal() -> None:
    seeds = torch.arange(300)
    drawn = RowNoise(seeds).draw_spread(7, (3, 2))
    assert drawn.shape == (300, 7, 3, 2)
    flat = drawn.flatten(2)
    assert torch.equal(flat[:, 1], -flat[:, 0]) and torch.equal(flat[:, 3], -flat[:, 2])
    assert float((flat[:, 0] * flat[:, 2]).sum(dim=-1).abs().max()) < 1e-4
    one = flat[:, 4]
    assert abs(float(one.mean())) < 0.05 and abs(float(one.std()) - 1.0) < 0.05
    assert float((one.T @ one / 300 - torch.eye(6)).abs().max()) < 0.25
    # more pairs than dimensions: blocks, still normal
    many = RowNoise(seeds).draw_spread(41, (1, 2)).flatten(0, 1)
    assert many.shape == (300 * 41, 1, 2) and abs(float(many.var()) - 1.0) < 0.06


def test_a_row_keeps_its_numbers_whoever_its_neighbours_are() -> None:
    together = RowNoise(torch.tensor([5, 6, 7])).draw_spread(4, (5, 2))
    assert torch.equal(RowNoise(torch.tensor([6])).draw_spread(4, (5, 2))[0], together[1])
