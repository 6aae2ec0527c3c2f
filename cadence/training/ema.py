"""Exponential moving average of the weights: what is validated and shipped."""

import copy

import torch
from torch import nn


class Ema:
    """A slowly following copy of a network (`network`), updated after optimiser steps.

    The decay starts low, min(decay, (1 + n) / (10 + n)), so that the copy forgets the random start.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.network = copy.deepcopy(network).requires_grad_(False).eval()
        self.decay = decay
        self.num_updates = 0

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Follow `network` by one update."""
        decay = min(self.decay, (1.0 + self.num_updates) / (10.0 + self.num_updates))
        for mine, theirs in zip(self.network.parameters(), network.parameters(), strict=True):
            mine.lerp_(theirs, 1.0 - decay)
        self.num_updates += 1
