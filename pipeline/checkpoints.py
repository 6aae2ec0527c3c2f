"""Checkpoints: weights as safetensors (never pickle), everything else as JSON beside them."""

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

import cadence
from cadence.errors import ConfigError, DeviceError
from pipeline.config import config_as_dict, read_config
from pipeline.documents import parse_json
from pipeline.files import hash_file, replacing, write_atomic
from pipeline.suggestions import did_you_mean

Network = TypeVar("Network", bound=nn.Module)

FORMAT = 1
WEIGHTS_NAME = "checkpoint.safetensors"
"""What a training calls its weights, in a folder of its own."""

_MAX_SIZE = 2**14
"""No network has more of anything; layers without end would be built for ever."""
_SPARE_NUMBERS = 1_000_000
"""For what a network makes beside its weights."""
_CREATORS = (torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn)

DEFAULT = "general"
"""Name of the shipped checkpoint that is used unless another is asked for."""


@dataclass(frozen=True)
class CheckpointInfo:
    """The JSON beside the weights.

    preset    "general", "paper", "place" ("scene" in 0.3), or a rival's
    network   the network's configuration
    training  command, seed, steps and data that made it
    scores    what validation measured
    """

    preset: str = field(metadata={"older_values": {"scene": "place"}})
    network: dict[str, Any]
    training: dict[str, Any] = field(default_factory=dict)
    scores: dict[str, Any] = field(default_factory=dict)
    format: int = FORMAT


def find_checkpoint(name: str) -> Path:
    """The weights file for a path, or for the name of a shipped checkpoint."""
    shipped = Path(cadence.__file__).parent / "checkpoints"
    path = Path(name) if name.endswith(".safetensors") else shipped / f"{name}.safetensors"
    if not path.is_file():
        known = sorted(p.stem for p in shipped.glob("*.safetensors"))
        raise ConfigError(
            f"checkpoint {name!r}: not found{did_you_mean(name, known)}; give a .safetensors file or a shipped name "
            f"({', '.join(known) or 'none'})"
        )
    return path


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


def read_info(path: Path) -> CheckpointInfo:
    """The JSON beside the weights at `path`."""
    beside = path.with_suffix(".json")
    try:
        content = parse_json(beside.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"{beside}: cannot read the checkpoint's description ({error.strerror}); it belongs beside them"
        ) from error
    except ValueError as error:
        raise ConfigError(f"{beside}: not valid JSON ({error}); take the checkpoint again from where it came") from error
    if not isinstance(content, Mapping) or content.get("format") != FORMAT:
        raise ConfigError(f"{beside}: not a checkpoint of format {FORMAT}; train again or take one that fits this version")
    return read_config(CheckpointInfo, content, str(beside))


def expect_preset(path: Path, *presets: str) -> CheckpointInfo:
    """What stands beside the weights at `path`; `ConfigError` where they are of another preset."""
    info = read_info(path)
    if info.preset not in presets:
        wanted = " or ".join(map(repr, presets))
        raise ConfigError(f"{path}: a checkpoint of the preset {info.preset!r}, expected one of the preset {wanted}")
    return info


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


def windows_seen(training: Mapping[str, Any]) -> int | None:
    """Training windows behind a checkpoint, by what it says of its training; None where that says too little."""
    steps, batch = training.get("steps"), (training.get("config") or {}).get("batch_size")
    windows: int | None = training.get("windows", steps * batch if steps and batch else None)
    return windows


def checkpoint_hash(path: Path) -> str:
    """Hash of weights and JSON together, for manifests."""
    return hash_file(path)[:16] + hash_file(path.with_suffix(".json"))[:16]


def network_config(cls: type[Any], info: CheckpointInfo, where: Path) -> Any:
    """The network's configuration as an instance of `cls`."""
    if not dataclasses.is_dataclass(cls):
        raise TypeError(f"{cls} is not a dataclass")
    beside = where.with_suffix(".json")
    if _largest(info.network) > _MAX_SIZE:
        raise ConfigError(f"{beside}: network: states a size of {_largest(info.network):g}; take the checkpoint again")
    return read_config(cls, info.network, f"{beside}: network")


def _largest(value: Any) -> int:
    """The largest whole number anywhere in a JSON value; 0 where there is none."""
    if isinstance(value, Mapping | list):
        return max(map(_largest, value.values() if isinstance(value, Mapping) else value), default=0)
    return value if isinstance(value, int) else 0
