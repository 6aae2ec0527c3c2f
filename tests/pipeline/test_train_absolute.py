"""Training of the paper's preset: windows from missions, map limits, validation by episode, resuming."""

import csv
import dataclasses

import numpy as np
import pytest
import torch

from cadence.diffusion.absolute import AbsoluteConfig, AbsoluteSampling
from cadence.errors import ConfigError, InputError
from cadence.network.trajectory import TrajectoryNetwork, TrajectoryNetworkConfig
from cadence.training.loop import OptimiserConfig
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from pipeline.absolute import absolute_grid, load_absolute, placed
from pipeline.checkpoints import CheckpointInfo, read_info, save_checkpoint
from pipeline.config import config_as_dict, read_config
from pipeline.progress import Progress
from pipeline.simulate import SimulateConfig, simulate
from pipeline.train import TrainConfig, train
from pipeline.train_absolute import AbsoluteTraining, draw_windows, mission_windows
from pipeline.training_tables import mission_of_episode, missions_of_logs
from pipeline.windows import build_windows, plan_grid

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

    class Killed(Exception):
        pass

    class Bar:
        def __init__(self):
            self.count = 0

        def __enter__(self):
            return self

        def __exit__(self, *args):
            return None

        def update(self, n):
            self.count += n
            if self.count == 3:
                raise Killed

        def set_postfix_str(self, text):
            pass

    class Killer(Progress):
        def bar(self, total, label, unit="it", scale=False):
            return Bar()

    with pytest.raises(Killed):
        train(tmp_path / "broken", config(), Killer(quiet=True))
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
    found = placed(model, windows).sample(windows.batch, 3)
    assert found.position_m.shape == (windows.batch.num_windows, 3, 1, 16, 2)
    save_checkpoint(weights, network, CheckpointInfo("general", config_as_dict(MODEL)))
    with pytest.raises(ConfigError, match="preset 'general'"):
        load_absolute(weights)


def test_training_from_logs(tmp_path):
    """Whole logs are kept for validation; map limits come from the others; logs that cannot be used are left out."""
    logs = tmp_path / "logs"
    simulate(logs, SimulateConfig(num_episodes=3, duration_s=3600.0, step_s=30.0, detection_rate=0.4), QUIET)
    (logs / "broken.mcap").write_bytes(b"not an mcap")
    missions = missions_of_logs(logs, tmp_path / "run" / "logs", PAPER.extract, QUIET)
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
