"""Training of the paper's preset: windows from missions, map limits, validation by episode, resuming."""

import csv
import dataclasses

import numpy as np
import pytest
import torch
from fixtures.killed_training import Killed, Killer

from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.absolute import AbsoluteConfig
from cadence.diffusion.settings import AbsoluteSampling
from cadence.errors import ConfigError, InputError
from cadence.network.trajectory import TrajectoryNetwork, TrajectoryNetworkConfig
from cadence.recordings import Recordings, cut_windows
from cadence.training.absolute import forecast_rows
from cadence.training.loop import OptimiserConfig
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from pipeline.checkpoints import CheckpointInfo, read_info
from pipeline.config import config_as_dict, read_config
from pipeline.episodes.pool import EpisodeSource
from pipeline.episodes.recordings import RecordingsConfig, save_recordings
from pipeline.estimators.paper import absolute_grid, load_absolute
from pipeline.estimators.presets import load_forecaster
from pipeline.extract.config import ExtractConfig
from pipeline.grids import plan_grid
from pipeline.progress import Progress
from pipeline.simulate.stage import SimulateConfig, simulate
from pipeline.train.config import AbsoluteTraining, TrainConfig
from pipeline.train.missions import mission_of_episode, missions_of_logs
from pipeline.train.paper import draw_windows, mission_windows
from pipeline.train.stage import train
from pipeline.weights import save_checkpoint
from pipeline.windows import build_windows

QUIET = Progress(quiet=True)
PATROL = PatrolConfig(duration_s=3600.0, step_s=30.0, detection_rate=0.3)
NETWORK = TrajectoryNetworkConfig(num_steps=16, width=8, multipliers=(1, 2), num_blocks=1, encoder_size=8, level_size=8)
PAPER = AbsoluteTraining(NETWORK, num_windows=12, num_episodes=2, num_validation_episodes=1, patrol=PATROL)
MODEL = AbsoluteConfig(NETWORK, scale_m=15_000.0)


def config(num_steps=4, **changes):
    optimiser = OptimiserConfig(num_steps=num_steps, warm_up_steps=1)
    return TrainConfig("paper", batch_size=8, validate_every=2, save_every=2, optimiser=optimiser, paper=PAPER, **changes)


@pytest.fixture(scope="module")
def episode():
    for seed in range(20):
        found = simulate_patrol(PATROL, np.random.default_rng(seed))
        if len(found.detections) > 8:
            return found
    raise AssertionError("no episode with detections")


def test_windows_are_the_truth_in_network_units(episode):
    mission = mission_of_episode(episode, "one")
    windows = mission_windows(mission, PAPER, MODEL, 3)
    drawn = draw_windows(mission, PAPER, MODEL, 3)
    origins = drawn.windows.origins_ns[drawn.windows.batch.is_active[:, 0].numpy()]
    assert 0 < len(windows) == len(origins) <= PAPER.num_windows
    assert windows.clean.shape[1:] == (16, 2) and windows.rows.shape[1:] == (32, 3)
    for row, origin in enumerate(origins):
        first = int(origin // 30_000_000_000)
        steps = np.minimum(first + 2 * np.arange(16), len(episode.time_s) - 1)  # parked after the end
        np.testing.assert_allclose(windows.clean[row] * 15_000.0, episode.truth_m[0, steps], atol=0.01)
        last = episode.detections.step[episode.detections.step <= first].max()
        count = int(windows.is_observed[row].sum())
        assert float(windows.rows[row, count - 1, 0]) == pytest.approx((first - last) / 2 / MODEL.age_scale_steps, abs=1e-6)
    assert windows.is_known.all()


def test_truth_that_ends_does_not_count_unless_parked(episode):
    mission = mission_of_episode(episode, "one")
    loose = mission_windows(mission, dataclasses.replace(PAPER, parked_tail=False), MODEL, 3)
    parked = mission_windows(mission, PAPER, MODEL, 3)
    assert not loose.is_known.all() and loose.is_known[:, 0].all()
    assert torch.equal(loose.clean, parked.clean)


def test_relative_windows_forget_where_they_are(episode):
    mission = mission_of_episode(episode, "one")
    relative = dataclasses.replace(MODEL, relative=True)
    moved = dataclasses.replace(episode, truth_m=episode.truth_m + 5000.0)
    seen = dataclasses.replace(episode.detections, position_m=episode.detections.position_m + 5000.0)
    moved = mission_of_episode(dataclasses.replace(moved, detections=seen), "two")
    here, there = (mission_windows(m, PAPER, relative, 3) for m in (mission, moved))
    torch.testing.assert_close(here.clean, there.clean, atol=1e-5, rtol=0)
    torch.testing.assert_close(here.rows, there.rows, atol=1e-5, rtol=0)
    last = here.rows[torch.arange(len(here)), here.is_observed.sum(1) - 1]
    assert last[:, 1:].abs().max() == 0
    assert not torch.allclose(*(mission_windows(m, PAPER, MODEL, 3).clean for m in (mission, moved)), atol=1e-2)


def test_a_killed_training_goes_on_and_ends_as_an_unbroken_one(tmp_path):
    whole = train(tmp_path / "whole", config(), QUIET)

    with pytest.raises(Killed):
        train(tmp_path / "broken", config(), Killer())
    again = train(tmp_path / "broken", config(), QUIET)
    assert again.summary["steps"] == 4
    for name in ("checkpoint.safetensors", "curve.csv"):
        assert (tmp_path / "broken" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert all(path.is_file() for path in whole.outputs)
    with (tmp_path / "whole" / "curve.csv").open(newline="") as file:
        assert [row[0] for row in csv.reader(file)] == ["step", "2", "4"]
    assert load_absolute(tmp_path / "whole" / "checkpoint.safetensors").config == MODEL


def test_a_checkpoint_samples_the_grid_it_asks_for(episode, tmp_path):
    network, weights = TrajectoryNetwork(NETWORK), tmp_path / "net.safetensors"
    save_checkpoint(weights, network, CheckpointInfo("paper", config_as_dict(MODEL)))
    model = load_absolute(weights, AbsoluteSampling("dpmpp", 3))
    mission = mission_of_episode(episode, "one")
    grid = plan_grid(mission.detections, absolute_grid(model.config, 8))
    windows = build_windows(mission.detections, grid, 0)
    assert int(windows.batch.detections.count[-1, 0]) > 1  # from before the only step of history
    found = model.sample(windows.located(0, Obstacles.none()).batch, 3)
    assert found.position_m.shape == (windows.batch.num_windows, 3, 1, 16, 2)
    save_checkpoint(weights, network, CheckpointInfo("general", config_as_dict(MODEL)))
    with pytest.raises(ConfigError, match="preset 'general'"):
        load_absolute(weights)


FORECAST = TrajectoryNetworkConfig(
    width=8, multipliers=(1, 2), num_blocks=1, encoder_size=8, level_size=8, max_detections=6, known_goal=True, elapsed=True
)


def recordings(seed=0, num=6, step_s=60.0):
    rng = np.random.default_rng(seed)
    length = rng.integers(20, 60, num)
    total = int(length.sum())
    return Recordings(
        step_s,
        np.concatenate([[0], np.cumsum(length)]),
        np.cumsum(rng.normal(0, 40, (total, 2)), axis=0).astype(np.float32),
        rng.random(total) < 0.4,
        rng.normal(0, 2000, (total, 2, 2)).astype(np.float32),
        rng.normal(0, 2000, (num, 2)).astype(np.float32),
    )


def test_forecasting_windows_are_the_truth_in_network_units():
    """Goal and elapsed share, the last detections with the start among them, and the target parked after the end."""
    rec = recordings()
    rec.is_detected[:2] = False, True
    model = AbsoluteConfig(FORECAST, centre_m=(300.0, -200.0), scale_m=4000.0)
    episode, step = np.array([0, 1, 2]), np.array([1, 10, int(rec.length[2]) - 2])
    found = forecast_rows(cut_windows(rec, episode, step, num_detections=6), model)
    for row, (e, t) in enumerate(zip(episode, step, strict=True)):
        begin, end = rec.offset[e], rec.offset[e + 1]
        rows = np.minimum(begin + t + np.arange(120), end - 1)
        np.testing.assert_allclose(found.clean[row] * 4000.0, rec.position_m[rows] - [300.0, -200.0], atol=0.01)
        seen = np.flatnonzero(rec.is_detected[begin : begin + t + 1] | (np.arange(t + 1) == 0))[-6:]
        assert int(found.is_observed[row].sum()) == len(seen)
        np.testing.assert_allclose(found.rows[row, : len(seen), 0] * 4320, t - seen, atol=1e-3)
        places = rec.position_m[begin + seen] - [300.0, -200.0]
        np.testing.assert_allclose(found.rows[row, : len(seen), 1:] * 4000.0, places, atol=0.01)
        np.testing.assert_allclose(found.extra[row, :2] * 4000.0, rec.known_goal_m[e] - [300.0, -200.0], atol=0.01)
        assert float(found.extra[row, 2]) == pytest.approx(t / 4320)
    assert found.is_known.all() and torch.equal(found.clean[2, 1], found.clean[2, 119])


@pytest.fixture
def of_episodes(tmp_path):
    save_recordings(tmp_path / "a.npz", recordings(0))
    save_recordings(tmp_path / "b.npz", recordings(1))
    sources = tuple(
        EpisodeSource(share, RecordingsConfig(data=tmp_path / name)) for share, name in ((1.0, "a.npz"), (3.0, "b.npz"))
    )
    paper = AbsoluteTraining(FORECAST, sources=sources, hidden_goals=0.5, num_validation_windows=20)
    return dataclasses.replace(config(), paper=paper, optimiser=OptimiserConfig(num_steps=4, warm_up_steps=1, bf16=True))


def test_training_from_episodes_goes_on_where_it_was_and_forecasts(of_episodes, tmp_path):
    whole = train(tmp_path / "whole", of_episodes, QUIET)
    with pytest.raises(Killed):
        train(tmp_path / "killed", of_episodes, Killer())
    train(tmp_path / "killed", of_episodes, QUIET)
    for name in ("checkpoint.safetensors", "curve.csv"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    model = load_absolute(whole.outputs[0], AbsoluteSampling("dpmpp", 2))
    first = [recordings(seed).select(slice(0, 5)).position_m for seed in (0, 1)]  # the last episode of each is for validation
    assert model.config.scale_m == pytest.approx(1.02 * max(np.ptp(np.concatenate(first), axis=0)) / 2)
    cut = cut_windows(recordings(2), np.array([0, 1]), np.array([10, 5]))
    found = model.sample(cut.windows, 2).position_m
    assert found.shape == (2, 2, 1, 120, 2) and bool(found.isfinite().all())
    nobody = dataclasses.replace(cut.context, known_goal_m=torch.full((2, 1, 2), torch.nan))
    assert load_forecaster(str(whole.outputs[0])).config.optional_goal
    hidden = model.sample(cut.windows.with_context(nobody), 2).position_m
    assert bool(hidden.isfinite().all()) and not torch.allclose(hidden, found, atol=0.01)
    strict = dataclasses.replace(model, config=dataclasses.replace(model.config, optional_goal=False))
    with pytest.raises(ConfigError, match="goal"):
        strict.sample(cut.windows.with_context(nobody), 2)


def test_episodes_that_do_not_fit(of_episodes, tmp_path):
    with pytest.raises(ConfigError, match="both"):
        train(tmp_path / "out", dataclasses.replace(of_episodes, data=tmp_path), QUIET)
    save_recordings(tmp_path / "slow.npz", recordings(0, step_s=30.0))
    save_recordings(tmp_path / "one.npz", recordings(0, 1))
    for name, words in (("slow.npz", "step_s"), ("one.npz", "single episode")):
        source = (EpisodeSource(1.0, RecordingsConfig(data=tmp_path / name)),)
        paper = dataclasses.replace(of_episodes.paper, sources=source)
        with pytest.raises(ConfigError, match=words):
            train(tmp_path / "out", dataclasses.replace(of_episodes, paper=paper), QUIET)
    for changes in ({"history_steps": 2}, {"hidden_goals": 1.5}, {"sources": ()}):
        with pytest.raises(ValueError):
            dataclasses.replace(of_episodes.paper, **changes)
    with pytest.raises(ValueError, match="sources"):
        AbsoluteTraining(validation=of_episodes.paper.sources)


def test_training_from_logs(tmp_path):
    """Whole logs are kept for validation; map limits come from the others; logs that cannot be used are left out."""
    logs = tmp_path / "logs"
    simulate(
        logs, SimulateConfig(num_episodes=3, patrol=PatrolConfig(duration_s=3600.0, step_s=30.0, detection_rate=0.4)), QUIET
    )
    (logs / "broken.mcap").write_bytes(b"not an mcap")
    missions = missions_of_logs(logs, tmp_path / "run" / "logs", ExtractConfig(), QUIET)
    assert [mission.name for mission in missions] == [f"patrol-0-000{i}" for i in range(3)]
    assert all(len(mission.truth) == 121 for mission in missions)
    result = train(tmp_path / "run", config(2, data=logs), QUIET)
    assert np.isfinite(result.summary["validation_loss"])
    settings = read_info(tmp_path / "run" / "checkpoint.safetensors").network
    extent = max(
        np.abs(np.array(m.truth[name]) - c).max()
        for m in missions
        for name, c in zip(("x_m", "y_m"), settings["centre_m"], strict=True)
    )
    assert 0.3 * extent < settings["scale_m"] <= 1.021 * extent


def test_folders_that_hold_nothing_to_train_on(tmp_path):
    with pytest.raises(InputError, match="not a folder"):
        train(tmp_path / "run", config(data=tmp_path / "absent"), QUIET)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no \.mcap"):
        train(tmp_path / "run", config(data=tmp_path / "empty"), QUIET)
    (tmp_path / "empty" / "a.mcap").write_bytes(b"not an mcap")
    with pytest.raises(InputError, match="no log in it"):
        train(tmp_path / "run", config(data=tmp_path / "empty"), QUIET)


def test_settings_that_contradict_each_other():
    for changes in (
        {"history_steps": 17},
        {"validation_share": 1.0},
        {"network": dataclasses.replace(NETWORK, known_goal=True)},
    ):
        with pytest.raises(ValueError):
            dataclasses.replace(PAPER, **changes)
    found = read_config(TrainConfig, {"preset": "paper", "paper": {"network": {"width": 16}, "relative": True}}, "train")
    assert found.paper.relative and found.paper.network.width == 16
