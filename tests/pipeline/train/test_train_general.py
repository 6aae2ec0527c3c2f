"""Training of the general preset: killed and taken up again, settings that change, losses that break, logs with truth."""

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from fixtures.killed_training import Killed
from safetensors.torch import load_file

from cadence.errors import InputError
from cadence.network.residual import ResidualNetworkConfig
from cadence.training.loop import OptimiserConfig
from cadence.training.synthetic import SyntheticConfig
from cadence.worlds.patrol import PatrolConfig
from pipeline.checkpoints import read_info
from pipeline.config import config_as_dict
from pipeline.estimators.general import load_general
from pipeline.estimators.samplings import Samplings
from pipeline.progress import Progress
from pipeline.simulate.stage import SimulateConfig, simulate
from pipeline.train import general as train_general
from pipeline.train import shards
from pipeline.train.config import TrainConfig
from pipeline.train.stage import train

QUIET = Progress(quiet=True)
NETWORK = ResidualNetworkConfig(width=8, multipliers=(1, 2), encoder_size=8, level_size=8)
WINDOWS = SyntheticConfig(history_steps=16, horizon_steps=8, num_tracks=4, num_windows=2, num_samples=2)
OPTIMISER = OptimiserConfig(num_steps=5, warm_up_steps=1, bf16=True)
CONFIG = TrainConfig(
    batch_size=8, num_shards=2, validate_every=2, save_every=2, network=NETWORK, windows=WINDOWS, optimiser=OPTIMISER
)
OUTPUTS = ["checkpoint.json", "checkpoint.safetensors", "curve.csv", "curve.png"]


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "SCENARIOS_PER_SHARD", 2)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unbroken training."""
    out = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "SCENARIOS_PER_SHARD", 2)
        train(out, CONFIG, QUIET)
    return out


def curve(out: Path) -> list[list[str]]:
    with (out / "curve.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def test_a_training_leaves_a_checkpoint_and_its_curve(whole: Path) -> None:
    assert all((whole / name).is_file() for name in OUTPUTS)
    assert (whole / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert [row[0] for row in curve(whole)] == ["step", "2", "4", "5"]
    assert all(0.1 < float(value) < 100.0 for row in curve(whole)[1:] for value in row[1:])
    info = read_info(whole / "checkpoint.safetensors")
    assert info.preset == "general" and info.network == config_as_dict(NETWORK) and info.training["steps"] == 5
    assert info.scores["validation_loss"] == float(curve(whole)[-1][2])
    model = load_general(whole / "checkpoint.safetensors", Samplings(device="cpu")).estimator
    assert model.network is not None and model.network.config == NETWORK
    assert not any(path.name.endswith(".part") for path in whole.rglob("*"))


def killed_at(step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the loss of `step` never come back."""
    real, calls = train_general.residual_loss, [0]

    def loss(network: torch.nn.Module, windows: Any, generator: torch.Generator) -> torch.Tensor:
        if network.training:
            calls[0] += 1
            if calls[0] > step:
                raise Killed
        return real(network, windows, generator)

    monkeypatch.setattr(train_general, "residual_loss", loss)


@pytest.mark.parametrize("step", [1, 3])
def test_a_killed_training_goes_on_and_ends_as_an_unbroken_one(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    with monkeypatch.context() as patch:
        killed_at(step, patch)
        with pytest.raises(Killed):
            train(tmp_path, CONFIG, QUIET)
    assert (tmp_path / "state.safetensors").is_file() == (step >= 2)
    torch.rand(3)  # the global stream plays no part
    result = train(tmp_path, CONFIG, QUIET)
    assert result.summary["steps"] == 5
    for name in ("checkpoint.safetensors", "state.safetensors", "curve.csv"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes(), name


def test_a_finished_training_has_nothing_left_to_do(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (whole / "checkpoint.safetensors").read_bytes()
    killed_at(0, monkeypatch)
    assert train(whole, CONFIG, QUIET).summary["steps"] == 5
    assert (whole / "checkpoint.safetensors").read_bytes() == before
    with pytest.raises(Killed):
        train(whole, CONFIG, QUIET, force=True)


def test_other_settings_start_anew(whole: Path, tmp_path: Path) -> None:
    """Also other windows: those that lie there already are not taken for them."""
    train(tmp_path, CONFIG, QUIET)
    longer = dataclasses.replace(CONFIG, windows=dataclasses.replace(WINDOWS, history_steps=20))
    train(tmp_path, longer, QUIET)
    lengths = {load_file(path)["residual"].shape[1] for path in (tmp_path / "windows").iterdir()}
    assert lengths == {24, 28}
    assert (tmp_path / "checkpoint.safetensors").read_bytes() != (whole / "checkpoint.safetensors").read_bytes()
    assert len(curve(tmp_path)) == 4
    train(tmp_path, CONFIG, QUIET)
    assert (tmp_path / "checkpoint.safetensors").read_bytes() == (whole / "checkpoint.safetensors").read_bytes()


def test_a_state_that_cannot_be_read(tmp_path: Path, whole: Path) -> None:
    (tmp_path / "curve.csv").write_bytes((whole / "curve.csv").read_bytes())
    (tmp_path / "state.safetensors").write_bytes(b"half of one")
    with pytest.raises(InputError, match="--force") as caught:
        train(tmp_path, CONFIG, QUIET)
    assert "\n" not in str(caught.value)


def test_the_seed_is_all_that_matters(whole: Path, tmp_path: Path) -> None:
    train(tmp_path, dataclasses.replace(CONFIG, seed=1), QUIET)
    assert (tmp_path / "checkpoint.safetensors").read_bytes() != (whole / "checkpoint.safetensors").read_bytes()


def test_settings_that_mean_nothing() -> None:
    for changes in ({"batch_size": 1}, {"num_shards": 0}, {"num_validation_shards": 0}, {"save_every": 0}):
        with pytest.raises(ValueError, match="at least"):
            dataclasses.replace(CONFIG, **changes)
    with pytest.raises(ValueError, match="multiple of 2"):
        dataclasses.replace(CONFIG, windows=dataclasses.replace(WINDOWS, horizon_steps=7))


def logs(folder: Path, num: int, duration_s: float = 5400.0) -> Path:
    simulate(
        folder,
        SimulateConfig(num_episodes=num, patrol=PatrolConfig(duration_s=duration_s, step_s=10.0, detection_rate=0.15)),
        QUIET,
    )
    return folder


def test_training_from_logs_with_truth(tmp_path: Path) -> None:
    data = logs(tmp_path / "logs", 3)
    (data / "broken.mcap").write_bytes(b"not an mcap")
    config = dataclasses.replace(CONFIG, data=data, optimiser=OptimiserConfig(num_steps=2, warm_up_steps=1))
    result = train(tmp_path / "run", config, QUIET)
    assert result.summary["steps"] == 2 and 0.0 < result.summary["validation_loss"] < 1e3
    assert not (tmp_path / "run" / "windows").exists()  # nothing synthetic
    content = json.loads((tmp_path / "run" / "checkpoint.json").read_text())
    assert content["training"]["config"]["data"] == str(data)


def test_logs_that_are_too_few_or_too_short(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        train(tmp_path / "run", dataclasses.replace(CONFIG, data=tmp_path / "absent"), QUIET)
    data = logs(tmp_path / "logs", 2)
    long = dataclasses.replace(WINDOWS, history_steps=16, horizon_steps=100_000)
    with pytest.raises(InputError, match="0 of 2 logs have windows with truth at every step") as caught:
        train(tmp_path / "run", dataclasses.replace(CONFIG, data=data, windows=long), QUIET)
    assert "\n" not in str(caught.value)
    sorted(data.glob("*.mcap"))[0].unlink()
    with pytest.raises(InputError, match="at least two"):
        train(tmp_path / "run", dataclasses.replace(CONFIG, data=data), QUIET)
