"""Training windows on disk: numbered shards, each a function of its seed alone, made once and kept.

A killed training finds its shards again; a shard is written beside its name and renamed, so half of one is never read.
"""

import dataclasses
import hashlib
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from cadence.network.residual_context import ResidualContext
from cadence.seeds import derived_seed
from cadence.training.synthetic import ResidualWindows, SyntheticConfig, synthesise
from pipeline.weights import write_tensors

SCENARIOS_PER_SHARD = 32

_CONTEXT_FIELDS = tuple(field.name for field in dataclasses.fields(ResidualContext))


def synthetic_shard(folder: Path, config: SyntheticConfig, seed: int, index: int) -> ResidualWindows:
    """Shard `index` of the stream that `seed` starts: read from `folder`, or made and left there.

    Its name tells how it was made, so that windows of other settings are never taken for it.
    """
    made_by = hashlib.sha256(repr((config, SCENARIOS_PER_SHARD)).encode()).hexdigest()[:8]
    path = folder / f"synthetic-{made_by}-{seed}-{index:05d}.safetensors"
    found = read_windows(path)
    if found is None:
        found = synthesise(config, derived_seed(seed, "shard", index), SCENARIOS_PER_SHARD)
        write_windows(found, path)
        # as it will be read: a training that was killed must not go on with other numbers than one that was not
        found = dataclasses.replace(found, sample=found.sample.to(torch.float16).float())
    return found


def write_windows(windows: ResidualWindows, path: Path) -> None:
    """Write training windows, whole or not at all."""
    tensors = {f"context.{name}": getattr(windows.context, name) for name in _CONTEXT_FIELDS}
    write_tensors(path, {**tensors, "residual": windows.residual, "sample": windows.sample.to(torch.float16)})


def read_windows(path: Path) -> ResidualWindows | None:
    """Training windows written before; None where there are none that can be read."""
    try:
        tensors = load_file(path)
        context = ResidualContext(*(tensors[f"context.{name}"] for name in _CONTEXT_FIELDS))
        return ResidualWindows(context, tensors["residual"], tensors["sample"].float())
    except (OSError, SafetensorError, KeyError):
        return None
