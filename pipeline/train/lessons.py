"""What the trainings of all presets have in common: windows, a loss on them, and windows of which the network never hears."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar

import torch
from torch import Tensor, nn

from cadence.seeds import torch_stream
from cadence.training.loop import Loss

_VALIDATION_BATCH = 256


class Windows(Protocol):
    """Training windows of any preset."""

    def __len__(self) -> int: ...


W = TypeVar("W", bound=Windows)


@dataclass(frozen=True)
class Lessons(Generic[W]):
    """What a network is taught, and by what it is examined.

    batch       the windows of a step; they depend on nothing but the step and the generator, which is the step's own
    loss        of a network on windows: scalar, the mean over them
    validation  windows that are never trained on, in parts
    examine     the loss on validation windows, where it is another one
    """

    batch: Callable[[int, torch.Generator], W]
    loss: Callable[[nn.Module, W, torch.Generator], Tensor]
    validation: Sequence[W]
    examine: Callable[[nn.Module, W, torch.Generator], Tensor] | None = None

    def loss_at(self, step: int, seed: int) -> Loss:
        """The loss of a step, its windows and random numbers closed over."""
        generator = torch_stream(seed, "step", step)
        windows = self.batch(step, generator)
        return lambda network: self.loss(network, windows, generator)

    @torch.no_grad()
    def validation_loss(self, network: nn.Module) -> float:
        """Mean over the validation windows, with the same random numbers each time: only the weights make a difference."""
        generator, examine = torch.Generator().manual_seed(1), self.examine or self.loss
        total = sum(float(examine(network, part, generator)) * len(part) for part in self.validation)
        return total / sum(map(len, self.validation))


class _Sliceable(Windows, Protocol):
    def __getitem__(self, rows: slice, /) -> Self: ...


S = TypeVar("S", bound=_Sliceable)


class Source(Protocol[S]):
    """Where windows come from: those of a step, which depend on nothing but it and the generator, and those kept apart."""

    validation: S

    def batch(self, step: int, generator: torch.Generator) -> S: ...  # noqa: D102


def lessons_of(source: Source[S], loss: Callable[[nn.Module, S, torch.Generator], Tensor]) -> Lessons[S]:
    """The loss on the windows of a source."""
    return Lessons(source.batch, loss, in_parts(source.validation, _VALIDATION_BATCH))


def in_parts(windows: S, size: int) -> list[S]:
    """The windows in their order, so many at a time."""
    return [windows[begin : begin + size] for begin in range(0, len(windows), size)]
