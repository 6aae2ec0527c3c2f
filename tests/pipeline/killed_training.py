"""A training that is killed after some steps."""

from dataclasses import dataclass
from typing import Any

from pipeline.progress import Progress


class Killed(Exception):
    """What ends the training."""


@dataclass(frozen=True)
class Killer(Progress):
    """Progress that ends a training at its `steps`-th step; other work goes on."""

    steps: int = 3
    quiet: bool = True

    def bar(self, total: int | None, label: str, unit: str = "it", scale: bool = False) -> Any:
        return _Bar(self.steps) if label == "train" else super().bar(total, label, unit, scale)


class _Bar:
    def __init__(self, steps: int) -> None:
        self.left = steps

    def __enter__(self) -> "_Bar":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def update(self, count: int) -> None:
        self.left -= count
        if self.left <= 0:
            raise Killed

    def set_postfix_str(self, text: str) -> None:
        pass
