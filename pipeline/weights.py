"""Weights of checkpoints: safetensors, never pickle, and the networks that they are put into."""

import functools
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from cadence.errors import ConfigError, DeviceError
from pipeline.checkpoints import CheckpointInfo
from pipeline.config import config_as_dict
from pipeline.files import replacing, write_atomic

Network = TypeVar("Network", bound=nn.Module)
_SPARE_NUMBERS = 1_000_000
"""For what a network makes beside its weights."""
_CREATORS = (torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn)


def save_checkpoint(path: Path, network: nn.Module, info: CheckpointInfo) -> None:
    """Write weights and JSON; each atomically, the JSON last."""
    write_tensors(path, network.state_dict())
    write_atomic(path.with_suffix(".json"), json.dumps(config_as_dict(info), indent=1, sort_keys=True) + "\n")


def write_tensors(path: Path, tensors: Mapping[str, Tensor], note: str | None = None) -> None:
    """Write a safetensors file, whole or not at all; `read_note` finds what `note` says of it."""
    with replacing(path) as draft:
        try:
            # one entry: several would stand in another order each time
            metadata = None if note is None else {"note": note}
            save_file({name: value.contiguous() for name, value in tensors.items()}, draft, metadata)
        except SafetensorError as error:
            raise DeviceError(f"{path}: cannot write ({error}); check the folder and the free space") from error


def read_note(path: Path) -> str | None:
    """What `write_tensors` was told of the file."""
    with safe_open(path, "pt") as file:
        return (file.metadata() or {}).get("note")


@functools.lru_cache(maxsize=2)  # a worker runs many logs with the same weights; networks get copies
def _tensors(path: Path, size_bytes: int, modified_ns: int) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = load_file(path)
    return tensors


def load_network(path: Path, build: Callable[[], Network]) -> Network:
    """The network that `build` makes with the weights at `path`, ready to be evaluated; `ConfigError` where they do not fit."""
    try:
        with _Ration(path):
            network = build()
    except (ArithmeticError, AssertionError, LookupError, RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"{path.with_suffix('.json')}: describes no network ({reason}); take the checkpoint again") from error
    load_weights(path, network)
    return network.eval()


class _Ration(TorchFunctionMode):
    """Refuses to make tensors that hold more numbers, together, than a checkpoint has bytes: its JSON may state any size."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path, self._left = path, _SPARE_NUMBERS + (path.stat().st_size if path.is_file() else 0)

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        if func in _CREATORS and args:
            self._left -= math.prod(args[0] if isinstance(args[0], tuple | list) else args)
            if self._left < 0:
                beside = self._path.with_suffix(".json")
                raise ConfigError(
                    f"{beside}: describes a larger network than its weights are of; take both files of one training"
                )
        return func(*args, **(kwargs or {}))


def load_weights(path: Path, network: nn.Module) -> None:
    """Put the weights at `path` into `network`; `ConfigError` names the first tensor that does not fit."""
    try:
        about = path.stat()
        tensors = _tensors(path, about.st_size, about.st_mtime_ns)
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"{path}: not readable as safetensors ({error}); take the checkpoint again") from error
    expected = network.state_dict()
    for name, value in expected.items():
        if name not in tensors or tensors[name].shape != value.shape:
            got = tuple(tensors[name].shape) if name in tensors else "nothing"
            raise ConfigError(
                f"{path}: does not fit: {name} is {got}, should be {tuple(value.shape)}; take both files of one training"
            )
    extra = sorted(set(tensors) - set(expected))
    if extra:
        raise ConfigError(f"{path}: does not fit: holds {extra[0]}, which the network has not; take both files of one training")
    network.load_state_dict(tensors)
