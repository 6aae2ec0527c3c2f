"""The settings of the retrospect stage."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class RetrospectConfig:
    """How mission hypotheses are drawn; checkpoint, limits and association are those of infer.

    enabled         draw them at all
    num_hypotheses  stories of the whole mission
    seed            of all random numbers
    before_s        how far before an agent's first detection its tracks begin
    after_s         how far after its last detection they end
    step_s          seconds between steps; by default that of infer's windows, longer where there would be too many
    block_steps     steps after which a target may change its model of motion; by default the history of infer's windows
    gap_steps       about so many steps at most while nobody is seen: they are longer then
    max_steps       where step_s is not stated, steps are as long as it takes for no more than these
    max_positions   the same for steps times agents times hypotheses: 16 bytes each while they are drawn
    """

    enabled: bool = True
    num_hypotheses: int = 300
    seed: int = 0
    before_s: float = 0.0
    after_s: float = 0.0
    step_s: float | None = None
    block_steps: int | None = None
    gap_steps: int = 64
    max_steps: int = 4000
    max_positions: int = 40_000_000

    def __post_init__(self) -> None:
        if self.num_hypotheses < 1:
            raise ValueError(f"num_hypotheses must be at least 1, got {self.num_hypotheses}; enabled = false draws none")
        for name in ("before_s", "after_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {getattr(self, name)}")
        if self.step_s is not None and not 1e-6 <= self.step_s < math.inf:
            raise ValueError(f"step_s must be at least a microsecond, got {self.step_s}")
        least = {"block_steps": 2, "gap_steps": 2, "max_steps": 2, "max_positions": 1}
        for name, number in least.items():
            value = getattr(self, name)
            if value is not None and value < number:
                raise ValueError(f"{name} must be at least {number}, got {value}")
