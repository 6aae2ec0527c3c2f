"""Recurrent parts under autocast: the same bits as without it, on processors with and without kernels for bfloat16."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from cadence.baselines.recurrence import run_recurrence
from cadence.network.encoder import DetectionEncoder
from cadence.network.recurrent import Lstm

NUM_ROWS, SIZES = 7, [3, 2, 2]
Run = Callable[[Tensor], Tensor]
Make = Callable[[], tuple[Run, list[Tensor]]]


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def lstm() -> tuple[Run, list[Tensor]]:
    with torch.random.fork_rng(devices=[]):
        torch.random.manual_seed(0)
        module = Lstm(4, 16)
    return lambda rows: module(rows.view(1, NUM_ROWS, 4)), list(module.parameters())


def encoder() -> tuple[Run, list[Tensor]]:
    with torch.random.fork_rng(devices=[]):
        torch.random.manual_seed(0)
        module = DetectionEncoder(4, 16)
    is_observed = torch.ones(1, NUM_ROWS, dtype=torch.bool)
    return lambda rows: module(rows.view(1, NUM_ROWS, 4), is_observed), list(module.parameters())


def vrnn() -> tuple[Run, list[Tensor]]:
    h, z = 4, 2
    shapes = [(h, 4 * h), (h, h), (h,), (h, 2 * z), (2 * z,), (z, h), (h,), (h, 3 * h)]
    weights = [normal(*shape, seed=1 + index).requires_grad_() for index, shape in enumerate(shapes)]
    gates, noise = normal(NUM_ROWS, 3 * h, seed=10), normal(NUM_ROWS, z, seed=11)
    return lambda rows: torch.cat(run_recurrence(rows, gates, noise, tuple(weights), SIZES), dim=1), weights


@pytest.mark.parametrize("make", [lstm, encoder, vrnn])
def test_autocast_changes_neither_answer_nor_gradient(make: Make) -> None:
    run, weights = make()
    rows = normal(NUM_ROWS, 4, seed=20)
    plain = run(rows)
    expected = torch.autograd.grad(plain.square().sum(), weights)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = run(rows)
    assert found.dtype == torch.float32 and torch.equal(found, plain)
    gradients = torch.autograd.grad(found.square().sum(), weights)
    assert all(torch.equal(*pair) for pair in zip(gradients, expected, strict=True))


@pytest.mark.parametrize("make", [lstm, vrnn])
def test_what_autocast_rounded_before_is_read_in_float32(make: Make) -> None:
    run, _ = make()
    square = nn.Linear(4, 4, bias=False)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = square(normal(NUM_ROWS, 4))
        found = run(rounded)
    assert rounded.dtype == torch.bfloat16
    assert torch.equal(found, run(rounded.float()))
