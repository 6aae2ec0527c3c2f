"""Random numbers that belong to a row of a batch, whoever its neighbours are."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor


class RowNoise:
    """A random stream a row, so that a row's numbers do not depend on which others are computed with it."""

    def __init__(self, seeds: Tensor) -> None:
        self.generators = [torch.Generator().manual_seed(seed) for seed in seeds.tolist()]

    def draw(self, shape: Sequence[int]) -> Tensor:
        """Standard normal [R, *shape]."""
        return torch.stack([torch.randn(tuple(shape), generator=generator) for generator in self.generators])

    def draw_each(self, num_hypotheses: int, is_used: Tensor) -> Tensor:
        """Standard normal [R, K, N, 2], zero for detections that are not used; left-packed, whatever the padding."""
        noise = torch.zeros(len(is_used), num_hypotheses, is_used.shape[1], 2)
        for row, (generator, count) in enumerate(zip(self.generators, is_used.sum(dim=1).tolist(), strict=True)):
            noise[row, :, :count] = torch.randn(num_hypotheses, count, 2, generator=generator)
        return noise

    def draw_spread(self, num: int, shape: Sequence[int]) -> Tensor:
        """Standard normal [R, num, *shape] whose draws of a row keep apart from each other, as pairs of opposites.

        Directions are orthogonal in blocks as large as the dimension allows, lengths independent: every draw by itself is
        standard normal, but their mean, and what a smooth sampler makes of them, varies less (Yu et al., "Orthogonal Random
        Features", 2016; antithetic variates, Hammersley, Morton, 1956).
        """
        size = math.prod(shape)
        half = (num + 1) // 2
        rows = []
        for generator in self.generators:
            blocks = []
            for begin in range(0, half, size):
                count = min(size, half - begin)
                normal = torch.randn(size, count, generator=generator)
                length = torch.randn(count, size, generator=generator).norm(dim=1)
                directions, triangle = torch.linalg.qr(normal)
                directions = directions * torch.sign(torch.diagonal(triangle))
                blocks.append(length[:, None] * directions.T)
            drawn = torch.cat(blocks)
            rows.append(torch.stack([drawn, -drawn], dim=1).flatten(0, 1)[:num].reshape(num, *shape))
        return torch.stack(rows)
