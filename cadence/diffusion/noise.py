"""Random numbers that belong to a row of a batch, whoever its neighbours are."""

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

    def draw_pairs(self, num_hypotheses: int, shape: Sequence[int]) -> Tensor:
        """Standard normal [R, K, *shape], of which every second draw mirrors the one before.

        Few such antithetic draws (Hammersley, Morton, 1956) stand for a distribution better than as many independent ones.
        """
        return mirrored(self.draw(((num_hypotheses + 1) // 2, *shape)), num_hypotheses)

    def draw_each(self, num_hypotheses: int, is_used: Tensor) -> Tensor:
        """Standard normal [R, K, N, 2], zero for detections that are not used; left-packed, whatever the padding."""
        noise = torch.zeros(len(is_used), num_hypotheses, is_used.shape[1], 2)
        for row, (generator, count) in enumerate(zip(self.generators, is_used.sum(dim=1).tolist(), strict=True)):
            noise[row, :, :count] = torch.randn(num_hypotheses, count, 2, generator=generator)
        return noise


def mirrored(noise: Tensor, num_draws: int) -> Tensor:
    """Noise [R, N, ...], each draw followed by its mirror image: [R, K, ...] for a number of draws K of at most 2 N."""
    return torch.stack([noise, -noise], dim=2).flatten(1, 2)[:, :num_draws]
