"""What tracks must obey: obstacles and speed as costs with analytic gradients, an exact checker, a final repair."""

from typing import Protocol

from torch import Tensor


class Constraint(Protocol):
    """A cost of tracks [..., T, 2] in metres whose descent by its own gradient, with unit step, is stable."""

    def cost(self, position_m: Tensor) -> Tensor:
        """Cost [...], zero where the constraint holds."""
        ...

    def gradient(self, position_m: Tensor) -> Tensor:
        """Analytic gradient of the cost, like `position_m`; finite everywhere."""
        ...
