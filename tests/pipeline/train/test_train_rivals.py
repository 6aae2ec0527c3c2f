"""Training of the learned rivals: batches by seed and step, the best checkpoint, killed and resumed, two stages of GrAMMI."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from fixtures.killed_training import Killed, Killer

from cadence.baselines.grammi import GrammiNetworkConfig
from cadence.baselines.mixture import HistoryConfig
from cadence.baselines.vrnn import VrnnNetworkConfig
from cadence.errors import ConfigError
from cadence.recordings import Recordings, choose_windows, cut_windows
from cadence.training.loop import OptimiserConfig
from pipeline.checkpoints import read_info
from pipeline.config import read_config
from pipeline.episodes.recordings import RecordingsConfig, save_recordings
from pipeline.estimators.mixtures import load_rival
from pipeline.progress import Progress
from pipeline.train.config import RivalTraining, TrainConfig
from pipeline.train.rivals import train_rival
from pipeline.train.stage import train
from pipeline.weights import read_note

QUIET = Progress(quiet=True)
HISTORY = HistoryConfig(max_detections=12, tracker_steps=4)
RIVAL = RivalTraining(
    VrnnNetworkConfig(hidden_size=6, latent_size=2, history=dataclasses.replace(HISTORY, tracker_steps=0)),
    GrammiNetworkConfig(hidden_size=6, graph_size=4, tracker_size=3, history=HISTORY),
    num_validation_windows=30,
    tuning_steps=3,
)


def config(preset, num_steps=6, rival=RIVAL, bf16=False, **changes):
    optimiser = OptimiserConfig(num_steps=num_steps, warm_up_steps=1, learning_rate=0.01, bf16=bf16)
    return TrainConfig(preset, batch_size=16, validate_every=2, save_every=2, optimiser=optimiser, rival=rival, **changes)


def recordings(seed=0, num_episodes=4, length=60):
    """Walks to the north-east of different speed."""
    rng = np.random.default_rng(seed)
    num = num_episodes * length
    walk = np.cumsum(rng.uniform(0, 40, (num_episodes, length, 2)), axis=1)
    return Recordings(
        60.0,
        length * np.arange(num_episodes + 1),
        (walk + rng.uniform(0, 500, (num_episodes, 1, 2))).reshape(num, 2).astype(np.float32),
        rng.random(num) < 0.3,
        rng.uniform(0, 1000, (num, 2, 2)).astype(np.float32),
        rng.uniform(0, 1000, (num_episodes, 2)).astype(np.float32),
    )


@pytest.mark.parametrize("preset", ["vrnn", "grammi_without_mi"])
def test_a_killed_training_goes_on_and_ends_as_an_unbroken_one(preset, tmp_path):
    parts, rounded = (recordings(), recordings(1)), config(preset, bf16=True)
    train_rival(tmp_path / "whole", rounded, *parts, QUIET)
    with pytest.raises(Killed):
        train_rival(tmp_path / "broken", rounded, *parts, Killer(5))
    again = train_rival(tmp_path / "broken", rounded, *parts, QUIET)
    assert again.summary["steps"] == 6
    for name in ("checkpoint.safetensors", "curve.csv", "best.safetensors"):
        assert (tmp_path / "broken" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    found = [json.loads((tmp_path / folder / "checkpoint.json").read_text()) for folder in ("broken", "whole")]
    assert all(item["training"].pop("cpu_seconds") > 0 for item in found) and found[0] == found[1]
    other = train_rival(tmp_path / "other", dataclasses.replace(rounded, seed=1), *parts, QUIET)
    assert other.summary["validation_loss"] != again.summary["validation_loss"]


def test_the_checkpoint_is_the_best_one_and_not_the_last(tmp_path):
    """A learning rate that is far too high spoils the network after a good start."""
    spoiling = config("vrnn", 20)
    spoiling = dataclasses.replace(
        spoiling, optimiser=dataclasses.replace(spoiling.optimiser, learning_rate=3.0, ema_decay=0.0)
    )
    result = train_rival(tmp_path, spoiling, recordings(), recordings(1), QUIET)
    rows = [line.split(",") for line in (tmp_path / "curve.csv").read_text().split()[1:]]
    losses = {int(step): float(loss) for step, _, loss in rows}
    best = min(losses, key=losses.get)
    assert best != 20, "the learning rate of this test spoils nothing"
    assert result.summary["best_step"] == best and result.summary["validation_loss"] == losses[best]
    info = read_info(tmp_path / "checkpoint.safetensors")
    assert info.training["best_step"] == best and info.training["windows"] == 320
    assert info.scores == {"validation_loss": losses[best]}
    shorter = dataclasses.replace(spoiling, optimiser=dataclasses.replace(spoiling.optimiser, num_steps=2))
    train_rival(tmp_path, shorter, recordings(), recordings(1), QUIET)
    assert json.loads(read_note(tmp_path / "best.safetensors"))["step"] == 2  # another configuration forgets the old best


def test_grammi_goes_on_from_the_model_without_mutual_information(tmp_path):
    parts = recordings(), recordings(1)
    result = train_rival(tmp_path / "all", config("grammi"), *parts, QUIET)
    assert result.summary["steps"] == 3
    first = tmp_path / "all" / "without_mi" / "checkpoint.safetensors"
    assert read_info(first).preset == "grammi_without_mi" and not read_info(first).network["network"]["mutual_information"]
    train_rival(tmp_path / "one", config("grammi_without_mi"), *parts, QUIET)
    assert first.read_bytes() == (tmp_path / "one" / "checkpoint.safetensors").read_bytes()
    given = config("grammi", rival=dataclasses.replace(RIVAL, start=first))
    train_rival(tmp_path / "given", given, *parts, QUIET)
    assert (tmp_path / "given" / "checkpoint.safetensors").read_bytes() == result.outputs[0].read_bytes()
    wide = dataclasses.replace(RIVAL, start=first, grammi=dataclasses.replace(RIVAL.grammi, hidden_size=7))
    with pytest.raises(ConfigError, match="not the same network"):
        train_rival(tmp_path / "wide", config("grammi", rival=wide), *parts, QUIET)
    tuned, plain = load_rival(result.outputs[0]), load_rival(first)
    rec = recordings(2)
    found = cut_windows(rec, *choose_windows(rec, 8, np.random.default_rng(0)), num_tracker_steps=4)
    a, b = (model.mixture(found.windows) for model in (tuned, plain))
    distance = (a.mean() - b.mean()).norm(dim=-1).mean()
    assert 0 < distance < 50, "fine-tuning by three small steps must change the answer, and not much"


def test_one_trunk_becomes_one_for_each_horizon(tmp_path):
    """A step too small to matter shows what a training begins with: the same answers, from more weights."""
    parts = recordings(), recordings(1)
    first = train_rival(tmp_path / "first", config("grammi_without_mi"), *parts, QUIET).outputs[0]
    apart = dataclasses.replace(RIVAL, start=first, grammi=dataclasses.replace(RIVAL.grammi, shared_trunk=False))
    still = dataclasses.replace(config("grammi_without_mi", rival=apart), optimiser=OptimiserConfig(1e-9, 1, 1))
    widened = train_rival(tmp_path / "apart", still, *parts, QUIET).outputs[0]
    network, shared = load_rival(widened).network, load_rival(first).network
    assert len(network.trunks) == len(network.horizons) > len(shared.trunks) == 1
    rec = recordings(2)
    found = cut_windows(rec, *choose_windows(rec, 8, np.random.default_rng(0)), num_tracker_steps=4)
    a, b = (load_rival(path).mixture(found.windows) for path in (widened, first))
    torch.testing.assert_close(a.mean_m, b.mean_m)
    assert (read_info(first).training["windows"], read_info(widened).training["windows"]) == (6 * 16, 7 * 16)
    with pytest.raises(ConfigError, match="not the same network"):  # trunks apart do not become one again
        back = dataclasses.replace(RIVAL, start=widened)
        train_rival(tmp_path / "back", config("grammi_without_mi", rival=back), *parts, QUIET)
    with pytest.raises(ConfigError, match="not the same network"):
        train_rival(tmp_path / "vrnn", config("vrnn", rival=dataclasses.replace(RIVAL, start=first)), *parts, QUIET)


def test_a_vrnn_goes_on_from_another_training(tmp_path):
    parts = recordings(), recordings(1)
    first = train_rival(tmp_path / "first", config("vrnn"), *parts, QUIET).outputs[0]
    going_on = dataclasses.replace(
        config("vrnn", rival=dataclasses.replace(RIVAL, start=first)), optimiser=OptimiserConfig(1e-9, 1, 1)
    )
    second = train_rival(tmp_path / "second", going_on, *parts, QUIET).outputs[0]
    for a, b in zip(*(load_rival(path).network.parameters() for path in (first, second)), strict=True):
        torch.testing.assert_close(a, b)
    before, after = (read_info(path).training for path in (first, second))
    assert after["windows"] == 7 * 16 and after["cpu_seconds"] > before["cpu_seconds"] > 0


def test_presets_by_configuration_with_sources(tmp_path):
    save_recordings(tmp_path / "walks.npz", recordings(num_episodes=10))
    sources = (RecordingsConfig(data=tmp_path / "walks.npz"),)
    rival = dataclasses.replace(RIVAL, sources=sources, validation_share=0.2)
    result = train(tmp_path / "run", config("grammi_without_mi", rival=rival), QUIET)
    model = load_rival(result.outputs[0])
    walked = recordings(num_episodes=10).position_m[: 8 * 60]
    low, high = walked.min(axis=0), walked.max(axis=0)
    assert model.frame.centre_m == pytest.approx(tuple(0.5 * (low + high)), rel=1e-6)
    assert model.frame.scale_m == pytest.approx(0.51 * (high - low).max(), rel=1e-6)
    few = tmp_path / "few.npz"
    save_recordings(few, recordings(num_episodes=1))
    lonely = dataclasses.replace(rival, sources=(RecordingsConfig(data=few),))
    with pytest.raises(ConfigError, match="one episode"):
        train(tmp_path / "other", config("vrnn", rival=lonely), QUIET)
    found = read_config(TrainConfig, {"preset": "grammi", "rival": {"sources": [{"world": "narco", "set": "high"}]}}, "train")
    assert found.rival.sources[0].world == "narco" and found.preset == "grammi"
    for bad in ({"validation_share": 0.0}, {"tuning_steps": 0}, {"kl_weight": -1.0}, {"scale_m": -1.0}):
        with pytest.raises(ConfigError):
            read_config(TrainConfig, {"rival": bad}, "train")


def test_checkpoints_of_other_presets_are_refused(tmp_path):
    train_rival(tmp_path, config("vrnn", 2), recordings(), recordings(1), QUIET)
    path = tmp_path / "checkpoint.safetensors"
    assert load_rival(path, uses_goal=True).uses_goal
    text = path.with_suffix(".json").read_text().replace('"vrnn"', '"general"')
    path.with_suffix(".json").write_text(text)
    with pytest.raises(ConfigError, match="expected one of the preset 'vrnn' or"):
        load_rival(path)


def test_training_leaves_the_global_stream_alone(tmp_path):
    torch.manual_seed(5)
    expected = torch.rand(2)
    torch.manual_seed(5)
    train_rival(tmp_path, config("vrnn", 2), recordings(), recordings(1), QUIET)
    assert torch.equal(torch.rand(2), expected)
