"""Recurrent parts compute in float32, whatever autocast says of the layers around them.

Roundings of a state that is fed back add up from step to step, the recurrence is a small part of the work, and torch has no
LSTM in bfloat16 for processors without kernels for it.
"""

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

_Result = TypeVar("_Result")


def run_in_float32(recurrence: Callable[..., _Result], *inputs: Tensor) -> _Result:
    """`recurrence(*inputs)` without autocast; inputs that autocast has rounded are float32 again, others as they are."""
    with torch.autocast(inputs[0].device.type, enabled=False):
        return recurrence(*(value.float() if value.dtype in (torch.bfloat16, torch.float16) else value for value in inputs))


class Lstm(nn.LSTM):
    """An LSTM of one layer over sequences [R, N, features], in float32 under autocast too."""

    def __init__(self, num_features: int, size: int) -> None:
        super().__init__(num_features, size, batch_first=True)

    def forward(self, rows: Tensor) -> Tensor:  # type: ignore[override]
        """The state after every row [R, N, size]."""
        states, _ = run_in_float32(super().forward, rows)
        return states
