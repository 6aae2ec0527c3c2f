"""Simulated logs say what their sensors detect, and extract makes looks of it that agree with the detections."""

import json
from pathlib import Path

import numpy as np
import pytest

from cadence.errors import InputError
from cadence.worlds.detection import detection_probability, mean_law
from pipeline.extract.config import ExtractConfig
from pipeline.extract.logged_sensors import logged_sensors
from pipeline.extract.writing import write_tables
from pipeline.logs.reader import open_log
from pipeline.looks import has_looks, read_footprints
from pipeline.mapping.sources import SourceConfig
from pipeline.progress import Progress
from pipeline.simulate.stage import SimulateConfig, simulate
from pipeline.tables import read_table

QUIET = Progress(quiet=True)


@pytest.mark.parametrize(("world", "seed"), [("patrol", 3), ("prison", 3), ("narco", 4)])
def test_every_detection_belongs_to_a_look_of_its_sensor(world: str, seed: int, tmp_path: Path) -> None:
    simulate(tmp_path / "logs", SimulateConfig(world=world, seed=seed, num_episodes=1), QUIET)
    (path,) = (tmp_path / "logs").glob("*.mcap")
    log, folder = open_log(path), tmp_path / "out"
    folder.mkdir()
    summary = write_tables(log, folder, ExtractConfig(), QUIET)
    assert not [line for line in summary["suspicions"] if "sensor" in line["subject"]]
    looks = read_table(folder / "looks.parquet", "looks")[0]
    num_hits = sum(len(names) > 0 for names in looks["seen"].to_pylist())
    num_detections = sum(read_table(folder / "detections.parquet", "detections")[0]["num_merged"].to_pylist())
    assert 0.95 * num_detections <= num_hits <= num_detections
    footprints = read_footprints(folder)
    assert all(footprint.trust == 1.0 for footprint in footprints)
    assert any(footprint.is_standing for footprint in footprints) == (world != "narco")
    assert any(footprint.is_hidden for footprint in footprints) == (world == "patrol")
    elsewhere = tmp_path / "without"
    elsewhere.mkdir()
    write_tables(log, elsewhere, ExtractConfig(sensors=(), suggest=False, detections=_sources(log), poses=()), QUIET)
    assert not has_looks(elsewhere)


def _sources(log):

    topic = next(channel.topic for channel in log.channels if channel.topic.startswith("/detections"))
    return (SourceConfig(topic, agent="T0"),)


def test_a_mean_law_is_the_mean() -> None:
    law = mean_law(np.array([100.0, 300.0]))
    expected = 0.5 * (detection_probability(law.distance_m, 100.0) + detection_probability(law.distance_m, 300.0))
    np.testing.assert_allclose(law.probability, expected, atol=1e-4)
    assert law.distance_m[-1] == 900.0 and law.probability[-1] == 0.0
    assert not mean_law(np.zeros(3)).probability[1:].any()


def test_a_record_that_cannot_be_meant_is_told() -> None:
    class Log:
        def __init__(self, text: str) -> None:
            self.text = text

        def metadata(self):
            return (("cadence.sensors", {"sensors": self.text}), ("other", {}))

    assert logged_sensors(Log("[]")) == ()
    for text in (
        "{",
        json.dumps([{"sensor": "a", "what": 1}]),
        json.dumps([{"sensor": "a", "probability": 2.0, "range_m": 1.0}]),
    ):
        with pytest.raises(InputError, match="not a list of sensors"):
            logged_sensors(Log(text))
