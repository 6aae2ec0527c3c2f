"""Checkpoints: what their JSON says of them. Their weights are in `weights`, since to know of them must not cost torch."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import cadence
from cadence.errors import ConfigError
from pipeline.config import read_config
from pipeline.documents import parse_json
from pipeline.files import hash_file
from pipeline.suggestions import did_you_mean

FORMAT = 1
WEIGHTS_NAME = "checkpoint.safetensors"
"""What a training calls its weights, in a folder of its own."""

_MAX_SIZE = 2**14
"""No network has more of anything; layers without end would be built for ever."""

Rival = Literal["vrnn", "grammi_without_mi", "grammi"]
RIVALS: Final[tuple[Rival, ...]] = ("vrnn", "grammi_without_mi", "grammi")
"""Presets of the paper's learned rivals."""

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
