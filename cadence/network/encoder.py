"""The encoder of detections: an LSTM over rows (age, x, y, ...), oldest first (CADENCE, section IV)."""

import torch
from torch import Tensor, nn

from cadence.network.recurrent import Lstm


class DetectionEncoder(nn.Module):
    """Rows of detections [R, N, features] and their mask [R, N] to one vector a row [R, size].

    Rows are left-packed, oldest first. A learned sentinel row goes in front, so that no detection at all has a meaning too.
    """

    def __init__(self, num_features: int, size: int) -> None:
        super().__init__()
        self.sentinel = nn.Parameter(torch.full((num_features,), -1.0))
        self.lstm = Lstm(num_features, size)

    def forward(self, rows: Tensor, is_observed: Tensor) -> Tensor:
        """The hidden state after each row's last detection."""
        sentinel = self.sentinel.to(rows.dtype).expand(len(rows), 1, -1)
        padded = torch.cat([sentinel, rows * is_observed[..., None]], dim=1)
        states: Tensor = self.lstm(padded)
        last = is_observed.sum(dim=1)
        return states[torch.arange(len(rows), device=rows.device), last]
