"""Training of the place preset: sources and their shares, resuming, the energy objective, checkpoints through infer."""

import csv
import dataclasses
import json

import numpy as np
import pyarrow as pa
import pytest
import torch
from fixtures.killed_training import Killed, Killer

from cadence.diffusion.place_frame import PlaceConfig
from cadence.diffusion.settings import GuidanceConfig, PlaceSampling
from cadence.errors import ConfigError, InputError
from cadence.network.place import PlaceNetworkConfig
from cadence.recordings import Recordings, cut_windows
from cadence.training.loop import OptimiserConfig
from pipeline.checkpoints import read_info
from pipeline.episodes.pool import EpisodeSource
from pipeline.episodes.recordings import RecordingsConfig, save_recordings
from pipeline.estimators.place import load_place_model
from pipeline.evaluate.stage import EvaluateConfig, evaluate
from pipeline.infer.config import InferConfig
from pipeline.infer.stage import infer
from pipeline.progress import Progress
from pipeline.tables import Frame, read_table, write_table
from pipeline.train.config import PlaceTraining, TrainConfig
from pipeline.train.stage import train
from schemas.tables import DETECTIONS, TRUTH

QUIET = Progress(quiet=True)
START_NS = 1_700_000_000_000_000_000
NETWORK = PlaceNetworkConfig(
    width=8, multipliers=(1, 2), encoder_size=8, code_size=8, level_size=8, max_detections=10, map_cells=4, map_channels=2
)
MODEL = PlaceConfig(NETWORK, centre_m=(0.0, 0.0), scale_m=5000.0, unit_step_m=60.0, max_step_m=100.0)


def recordings(seed, num_trackers=2, step_s=60.0):
    rng = np.random.default_rng(seed)
    length = rng.integers(20, 60, 5)
    total = int(length.sum())
    return Recordings(
        step_s,
        np.concatenate([[0], np.cumsum(length)]),
        np.cumsum(rng.normal(0, 40, (total, 2)), axis=0).astype(np.float32),
        rng.random(total) < 0.4,
        rng.normal(0, 2000, (total, num_trackers, 2)).astype(np.float32),
        rng.normal(0, 2000, (5, 2)).astype(np.float32),
    )


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    folder = tmp_path_factory.mktemp("episodes")
    found = []
    for seed, num_trackers in ((0, 2), (1, 4)):
        save_recordings(folder / f"{seed}.npz", recordings(seed, num_trackers))
        found.append(EpisodeSource(1.0 + seed, RecordingsConfig(data=folder / f"{seed}.npz")))
    return tuple(found)


def config(sources, num_steps=4, **changes):
    place = PlaceTraining(MODEL, sources=sources, validation=sources[:1], num_validation_windows=20, **changes)
    optimiser = OptimiserConfig(num_steps=num_steps, warm_up_steps=1, bf16=True)
    return TrainConfig("place", batch_size=12, validate_every=2, save_every=2, optimiser=optimiser, place=place)


def test_a_killed_training_goes_on_to_the_same_weights(sources, tmp_path):
    whole = train(tmp_path / "whole", config(sources), QUIET)
    with pytest.raises(Killed):
        train(tmp_path / "killed", config(sources), Killer())
    assert (tmp_path / "killed" / "state.safetensors").is_file()
    again = train(tmp_path / "killed", config(sources), QUIET)
    first, second = (load_place_model(result.outputs[0]).network.state_dict() for result in (whole, again))
    assert all(torch.equal(first[name], second[name]) for name in first)
    steps = [
        int(row[0]) for row in csv.reader((tmp_path / "killed" / "curve.csv").read_text().splitlines()) if row[0].isdigit()
    ]
    assert steps == [2, 4]


def test_energy_tunes_a_trained_network_for_few_steps(sources, tmp_path):
    train(tmp_path / "first", config(sources), QUIET)
    start = str(tmp_path / "first" / "checkpoint.safetensors")
    tuned = train(tmp_path / "second", config(sources, 2, objective="energy", start=start, few_steps=3), QUIET)
    model = load_place_model(tuned.outputs[0])
    assert model.config.few_steps == 3 and read_info(tuned.outputs[0]).preset == "place"
    cut = cut_windows(recordings(3), np.array([0, 1]), np.array([10, 5]))
    assert bool(model.sample(cut.windows, 2).position_m.isfinite().all())
    with pytest.raises(ValueError, match="start"):
        config(sources, objective="energy")


def test_episodes_with_another_step_are_refused(sources, tmp_path):
    save_recordings(tmp_path / "slow.npz", recordings(0, step_s=30.0))
    slow = (EpisodeSource(1.0, RecordingsConfig(data=tmp_path / "slow.npz")),)
    with pytest.raises(ConfigError, match="step_s"):
        train(tmp_path / "out", config(slow), QUIET)
    with pytest.raises(InputError, match="nowhere"):
        train(tmp_path / "out", config((EpisodeSource(1.0, RecordingsConfig(data=tmp_path / "nowhere.npz")),)), QUIET)


def test_infer_takes_a_place_checkpoint(sources, tmp_path, mission_directory):
    weights = train(tmp_path / "place", config(sources), QUIET).outputs[0]
    settings = InferConfig(num_hypotheses=3, checkpoint=str(weights), place=PlaceSampling(num_steps=2), is_tested=False)
    result = infer(mission_directory, settings, QUIET)
    assert result.summary["preset"] == "place" and result.summary["step_s"] == pytest.approx(60.0)
    table, _ = read_table(mission_directory / "hypotheses.parquet", "hypotheses")
    assert table.num_rows == result.summary["num_tracks"] > 0
    assert set(table["origin_index"].to_pylist()) == {0} and table.schema.field("position_m").type.list_size == 120
    first = (mission_directory / "hypotheses.parquet").read_bytes()
    infer(mission_directory, settings, QUIET, force=True)
    assert (mission_directory / "hypotheses.parquet").read_bytes() == first
    assert json.loads((mission_directory / "infer.manifest.json").read_text())["summary"]["checkpoint"] == str(weights)
    other = dataclasses.replace(settings, place=PlaceSampling(sampler="few"))
    with pytest.raises(ConfigError, match="not tuned"):
        infer(mission_directory, other, QUIET)


def test_all_that_infer_saw_is_seen_by_those_it_is_compared_with(sources, tmp_path, mission_directory):
    weights = train(tmp_path / "place", config(sources), QUIET).outputs[0]
    settings = InferConfig(num_hypotheses=3, checkpoint=str(weights), place=PlaceSampling(num_steps=2), is_tested=False)
    infer(mission_directory, settings, QUIET)
    rows = [
        {"log_id": "walk", "time_ns": START_NS + minute * 60 * 10**9, "agent_id": agent, "x_m": 30.0 * minute, "y_m": y_m}
        for minute in range(300) for agent, y_m in (("T0", 0.0), ("T1", 500.0))
    ]  # fmt: skip
    truth = pa.Table.from_pylist(rows, schema=TRUTH)
    write_table(truth, mission_directory / "truth.parquet", "truth", Frame("map", None, None))
    evaluate(mission_directory, EvaluateConfig(rivals=("cv",), num_resamples=20), QUIET)
    report = json.loads((mission_directory / "scores.json").read_text())
    asked = ("future", "part", "ade_m")
    found = {row["estimator"]: row for row in report["rows"] if (row["part"], row["by"], row["metric"]) == asked}
    # at the origins at least one agent was seen minutes ago, which a rival without memory could say nothing of
    num_drawn = read_table(mission_directory / "hypotheses.parquet", "hypotheses")[0].num_rows // 3
    assert found["cadence"]["num_cells"] == found["cv"]["num_cells"] == 119 * num_drawn


def test_the_limits_of_all_presets_hold_for_a_place_checkpoint(sources, tmp_path, mission_directory):
    weights = train(tmp_path / "place", config(sources), QUIET).outputs[0]
    rock = {"kind": "circle", "x_m": 1500.0, "y_m": 250.0, "radius_m": 300.0}
    (mission_directory / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": [rock]}))

    def least_distance_and_longest_step(**guidance):
        limits = GuidanceConfig(**guidance)
        settings = InferConfig(num_hypotheses=20, checkpoint=str(weights), guidance=limits, is_tested=False)
        infer(mission_directory, settings, QUIET)
        table, _ = read_table(mission_directory / "hypotheses.parquet", "hypotheses")
        place = np.array(table["position_m"].to_pylist()) + np.array([table["datum_x_m"], table["datum_y_m"]]).T[:, None]
        # a target may have been seen inside the margin: states from which it had time to leave are asked
        far = np.linalg.norm(place[:, 60:] - [rock["x_m"], rock["y_m"]], axis=-1).min() - rock["radius_m"]
        return far, np.linalg.norm(np.diff(place, axis=1), axis=-1).max()

    near, _ = least_distance_and_longest_step()
    far, _ = least_distance_and_longest_step(margin_m=100.0)
    _, fast = least_distance_and_longest_step(mode="none")  # without obstacles: a way around one is longer
    _, slow = least_distance_and_longest_step(mode="none", max_speed_mps=0.5)
    assert -1.0 < near < 99.0 <= far
    assert slow < 30.5 < fast


@pytest.fixture
def mission_directory(tmp_path):
    """Two agents, seen now and then in the course of two hours."""
    rows = []
    for number, agent in enumerate(("T0", "T1")):
        for minute in (0, 3, 4, 20 + number, 50, 90):
            row = {"log_id": "walk", "time_ns": START_NS + minute * 60 * 10**9, "sensor_id": "camera", "agent_id": agent}
            row |= {"x_m": 30.0 * minute, "y_m": 500.0 * number, "cov_xx_m2": 1.0, "cov_xy_m2": 0.0, "cov_yy_m2": 1.0}
            rows.append(row | {"num_merged": 1, "topic": "/seen", "log_time_ns": 0, "sequence": minute})
    rows.sort(key=lambda row: (row["time_ns"], row["agent_id"]))
    folder = tmp_path / "walk"
    folder.mkdir()
    table = pa.Table.from_pylist(rows, schema=DETECTIONS)
    write_table(table, folder / "detections.parquet", "detections", Frame("map", None, None))
    (folder / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": []}))
    return folder
