"""Checkpoints: round trips, and every way in which one does not fit."""

import json
from pathlib import Path

import pytest
import torch

from cadence.errors import CadenceError, ConfigError, DeviceError
from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from pipeline.checkpoints import DEFAULT, CheckpointInfo, checkpoint_hash, find_checkpoint, network_config, read_info
from pipeline.config import config_as_dict
from pipeline.estimators.general import load_general
from pipeline.estimators.samplings import Samplings
from pipeline.weights import load_weights, save_checkpoint

SMALL = ResidualNetworkConfig(width=8, multipliers=(1, 2), encoder_size=8, level_size=8)
INFO = CheckpointInfo("general", config_as_dict(SMALL), {"steps": 3}, {"validation_loss": 0.5})


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "new" / "net.safetensors"
    save_checkpoint(path, ResidualNetwork(SMALL), INFO)
    return path


def one_line(call: object, *arguments: object) -> CadenceError:
    """The error of a call, which must be one line."""
    with pytest.raises(CadenceError) as caught:
        call(*arguments)  # type: ignore[operator]
    assert "\n" not in str(caught.value) and len(str(caught.value)) > 20
    return caught.value


def edit(path: Path, **changes: object) -> None:
    beside = path.with_suffix(".json")
    beside.write_text(json.dumps(json.loads(beside.read_text()) | changes))


def test_round_trip(tmp_path: Path) -> None:
    path, network = tmp_path / "net.safetensors", ResidualNetwork(SMALL)
    save_checkpoint(path, network, INFO)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["net.json", "net.safetensors"]
    assert read_info(path) == INFO
    assert network_config(ResidualNetworkConfig, read_info(path), path) == SMALL
    other = ResidualNetwork(SMALL)
    load_weights(path, other)
    mine, theirs = network.state_dict(), other.state_dict()
    assert mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)
    assert find_checkpoint(str(path)) == path


def test_a_checkpoint_of_0_3_calls_the_place_preset_scene(saved: Path) -> None:
    edit(saved, preset="scene")
    assert read_info(saved).preset == "place"


def test_the_hash_tells_weights_and_description(saved: Path) -> None:
    first = checkpoint_hash(saved)
    assert first == checkpoint_hash(saved) and len(first) == 32
    edit(saved, training={"steps": 4})
    second = checkpoint_hash(saved)
    assert first[:16] == second[:16] and first[16:] != second[16:]
    save_checkpoint(saved, ResidualNetwork(SMALL), INFO)
    third = checkpoint_hash(saved)
    assert third[:16] != first[:16] and third[16:] == first[16:]


def test_the_shipped_checkpoint_is_whole() -> None:
    path = find_checkpoint(DEFAULT)
    model = load_general(path, Samplings(device="cpu")).estimator
    assert model.network is not None and not model.network.training
    assert all(torch.isfinite(value).all() for value in model.network.state_dict().values())


def test_unknown_names(tmp_path: Path) -> None:
    error = one_line(find_checkpoint, "nonesuch")
    assert isinstance(error, ConfigError) and "'nonesuch'" in str(error) and DEFAULT in str(error)
    assert isinstance(one_line(find_checkpoint, str(tmp_path / "absent.safetensors")), ConfigError)
    assert isinstance(one_line(find_checkpoint, "../checkpoints"), ConfigError)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "not valid JSON"),
        ("", "not valid JSON"),
        ("[1]", "format 1"),
        ('{"preset": "general", "network": {}}', "format 1"),
        ('{"preset": "general", "network": {}, "format": 2}', "format 1"),
        ('{"preset": "general", "network": {}, "format": 1, "sort": 3}', "sort"),
        ('{"preset": "general", "format": 1}', "network"),
        ('{"preset": 7, "network": {}, "format": 1}', "preset"),
    ],
)
def test_descriptions_that_cannot_be_used(saved: Path, content: str, says: str) -> None:
    saved.with_suffix(".json").write_text(content)
    error = one_line(read_info, saved)
    assert isinstance(error, ConfigError) and says in str(error) and "net.json" in str(error)


def test_a_description_that_is_absent_or_no_text(saved: Path) -> None:
    saved.with_suffix(".json").write_bytes(b"\xff\xfe{}")
    assert isinstance(one_line(read_info, saved), ConfigError)
    saved.with_suffix(".json").unlink()
    error = one_line(read_info, saved)
    assert isinstance(error, ConfigError) and "net.json" in str(error)


def test_weights_of_another_shape_or_network(saved: Path) -> None:
    wide = ResidualNetwork(ResidualNetworkConfig(width=16, multipliers=(1, 2), encoder_size=8, level_size=8))
    error = one_line(load_weights, saved, wide)
    assert isinstance(error, ConfigError) and "should be" in str(error)
    deep = ResidualNetwork(ResidualNetworkConfig(width=8, multipliers=(1, 2, 2), encoder_size=8, level_size=8))
    assert "nothing" in str(one_line(load_weights, saved, deep))
    less = ResidualNetwork(SMALL)
    del less.level
    assert "level.layers.0.bias, which the network has not" in str(one_line(load_weights, saved, less))


@pytest.mark.parametrize(
    "sizes",
    [
        {"width": 8 * 10**12},
        {"width": 16_000},
        {"width": 8, "multipliers": [1, 16_000]},
        {"width": 8, "num_blocks": 10**9},
        {"encoder_size": 16_000},
        {"width": -8},
        {"multipliers": []},
    ],
    ids=str,
)
def test_sizes_that_the_weights_do_not_have_are_refused_before_memory_is_asked_for(saved: Path, sizes: dict) -> None:
    edit(saved, network=config_as_dict(SMALL) | sizes)
    error = one_line(load_general, saved, Samplings(device="cpu"))
    assert isinstance(error, ConfigError) and "net." in str(error)


def test_weights_that_are_damaged(saved: Path) -> None:
    whole = saved.read_bytes()
    for damaged in (b"", whole[:50], whole[:-10], b"\xff" * 200):
        saved.write_bytes(damaged)
        assert isinstance(one_line(load_weights, saved, ResidualNetwork(SMALL)), ConfigError)


def test_models_of_other_presets_and_devices(saved: Path) -> None:
    edit(saved, preset="paper")
    error = one_line(load_general, saved, Samplings(device="cpu"))
    assert isinstance(error, ConfigError) and "paper" in str(error)
    edit(saved, preset="general", network={"wdith": 8})
    error = one_line(load_general, saved, Samplings(device="cpu"))
    assert isinstance(error, ConfigError) and "wdith" in str(error)
    edit(saved, network={"width": 9})  # refused by the U-Net: not a multiple of its groups
    assert isinstance(one_line(load_general, saved, Samplings(device="cpu")), ConfigError)
    for name in ("cuda:99", "toaster"):
        error = one_line(load_general, None, Samplings(device=name))
        assert isinstance(error, DeviceError) and name in str(error)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    error = one_line(save_checkpoint, tmp_path / "file" / "net.safetensors", ResidualNetwork(SMALL), INFO)
    assert isinstance(error, DeviceError)
