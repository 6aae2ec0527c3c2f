"""One optimiser step at a time, and a state that can be laid down as plain tensors and taken up again."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, nn

from cadence.training.ema import Ema

Loss = Callable[[nn.Module], Tensor]
"""A batch and its random numbers, closed over: network -> scalar loss."""

N = TypeVar("N", bound=nn.Module)


@dataclass(frozen=True)
class OptimiserConfig:
    """Adam with a linear warm-up and a cosine decay to a fiftieth.

    The paper: learning rate 2e-4, EMA 0.995 every 10 steps.

    learning_rate      after the warm-up
    num_steps          length of the training
    warm_up_steps      in which the rate grows from zero
    ema_decay          of the average of the weights, which is what is kept
    max_gradient_norm  longer gradients are shortened to it
    bf16               compute in bfloat16, where the processor is faster with it
    """

    learning_rate: float = 1e-3
    num_steps: int = 10_000
    warm_up_steps: int = 300
    ema_decay: float = 0.999
    max_gradient_norm: float = 1.0
    bf16: bool = False


def untrained(build: Callable[[], N], seed: int) -> N:
    """The network that `build` makes, with the first weights that belong to a seed."""
    with torch.random.fork_rng(devices=[]):  # layers take their first weights from the global stream, which is left as it was
        torch.random.manual_seed(seed)
        return build()


class Trainer:
    """A network, its average and its optimiser, `step` steps on."""

    def __init__(self, network: nn.Module, config: OptimiserConfig) -> None:
        self.network = network
        self.config = config
        self.ema = Ema(network, config.ema_decay)
        self.optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate, betas=(0.9, 0.99))
        self.step = 0

    def advance(self, loss_of: Loss) -> float:
        """One step; returns the loss. A loss that is not finite leaves the weights alone and is returned as it is."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.learning_rate * self._rate(self.step)
        self.optimiser.zero_grad(set_to_none=True)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.config.bf16):
            loss = loss_of(self.network)
        if torch.isfinite(loss):
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(self.network.parameters(), self.config.max_gradient_norm)
            self.optimiser.step()
            self.ema.update(self.network)
        self.step += 1
        return float(loss.detach())

    def state(self) -> dict[str, Tensor]:
        """Everything needed to go on, as named tensors."""
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= {f"ema.{name}": value for name, value in self.ema.network.state_dict().items()}
        for index, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        tensors["step"] = torch.tensor([self.step, self.ema.num_updates])
        return {name: value.detach().clone().contiguous() for name, value in tensors.items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from what `state` returned."""
        self.network.load_state_dict(_part(tensors, "network."))
        self.ema.network.load_state_dict(_part(tensors, "ema."))
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in _part(tensors, "adam.").items():
            index, key = name.split(".", 1)
            moments.setdefault(int(index), {})[key] = value
        saved = self.optimiser.state_dict()
        self.optimiser.load_state_dict({"state": moments, "param_groups": saved["param_groups"]})
        self.step, self.ema.num_updates = (int(value) for value in tensors["step"])

    def _rate(self, step: int) -> float:
        warm = min(1.0, (step + 1) / max(self.config.warm_up_steps, 1))
        done = min(1.0, step / max(self.config.num_steps, 1))
        return warm * (0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * done)))


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
