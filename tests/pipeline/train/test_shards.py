"""Training windows on disk: made once, read again, made again where they cannot be read."""

import dataclasses
from pathlib import Path

import pytest
import torch

from cadence.network.residual_context import ResidualContext
from cadence.training.synthetic import ResidualWindows, SyntheticConfig, synthesise
from pipeline.train import shards

CONFIG = SyntheticConfig(history_steps=16, horizon_steps=8, num_tracks=4, num_windows=1, num_samples=2)


@pytest.fixture(scope="module")
def made() -> ResidualWindows:
    return synthesise(CONFIG, 1, 2)


def same(one: ResidualWindows, two: ResidualWindows) -> bool:
    names = [field.name for field in dataclasses.fields(ResidualContext)]
    return torch.equal(one.residual, two.residual) and all(
        torch.equal(getattr(one.context, name), getattr(two.context, name)) for name in names
    )


def test_round_trip(tmp_path: Path, made: ResidualWindows) -> None:
    path = tmp_path / "new" / "shard.safetensors"
    shards.write_windows(made, path)
    found = shards.read_windows(path)
    assert found is not None and same(found, made)
    assert found.sample.dtype == torch.float32
    torch.testing.assert_close(found.sample, made.sample, rtol=1e-3, atol=1e-3)  # half precision on disk
    assert [entry.name for entry in path.parent.iterdir()] == ["shard.safetensors"]


def test_what_cannot_be_read_is_none(tmp_path: Path, made: ResidualWindows) -> None:
    path = tmp_path / "shard.safetensors"
    assert shards.read_windows(path) is None
    shards.write_windows(made, path)
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"\xff" * 100):
        path.write_bytes(damaged)
        assert shards.read_windows(path) is None


def test_a_shard_is_made_once_and_again_after_damage(
    tmp_path: Path, made: ResidualWindows, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def count(config: SyntheticConfig, seed: int, num_scenarios: int) -> ResidualWindows:
        calls.append(seed)
        return made

    monkeypatch.setattr(shards, "synthesise", count)
    first = shards.synthetic_shard(tmp_path, CONFIG, 3, 0)
    again = shards.synthetic_shard(tmp_path, CONFIG, 3, 0)
    assert len(calls) == 1 and same(first, again)
    (shard,) = tmp_path.iterdir()
    shard.write_bytes(b"half of one")
    assert same(shards.synthetic_shard(tmp_path, CONFIG, 3, 0), first)
    shards.synthetic_shard(tmp_path, CONFIG, 3, 1)
    shards.synthetic_shard(tmp_path, CONFIG, 4, 0)
    assert len(set(calls)) == 3  # each shard and stream has a seed of its own
