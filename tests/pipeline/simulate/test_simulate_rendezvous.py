"""Logs of the world rendezvous: of known and of unknown origin, in every form."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous
from cadence.worlds.rendezvous_map import GOALS_M, SITES_M
from pipeline.extract.config import ExtractConfig
from pipeline.extract.stage import extract
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.logs.reader import open_log
from pipeline.mapping.guess import suggest_mapping
from pipeline.progress import Progress
from pipeline.simulate.stage import SimulateConfig, simulate
from pipeline.tables import read_table

QUIET = Progress(quiet=True)
CONFIG = SimulateConfig(world="rendezvous", seed=3)
UNKNOWN = dataclasses.replace(CONFIG, rendezvous=RendezvousConfig(is_origin_known=False, clutter_per_step=0.1))


def extracted(folder: Path, config: SimulateConfig) -> tuple[dict[str, list[Any]], dict[str, list[Any]]]:
    """The columns of the detections and of the truth that the pipeline gets out of a log without any settings."""
    (log,) = simulate(folder, config, QUIET).outputs
    mission = folder / "mission"
    ingest(log, mission, IngestConfig(), QUIET)
    extract(mission, ExtractConfig(), QUIET)
    return tuple(read_table(mission / f"{name}.parquet", name)[0].to_pydict() for name in ("detections", "truth"))


@pytest.mark.parametrize("encoding", ["protobuf", "json", "cdr"])
def test_detections_of_known_origin_name_their_agents(tmp_path: Path, encoding: Any) -> None:
    episode = simulate_rendezvous(CONFIG.rendezvous, 3, 0)
    found, truth = extracted(tmp_path, dataclasses.replace(CONFIG, encoding=encoding))
    # With a topic an agent, the order within one step is that of the topics.
    order = np.lexsort((found["agent_id"], found["time_ns"]))
    agents = [episode.agent_ids[agent] for agent in episode.detections.agent]
    assert np.array(found["agent_id"])[order].tolist() == agents
    places = np.stack([found["x_m"], found["y_m"]], axis=-1)[order]
    np.testing.assert_allclose(places, episode.detections.position_m, atol=6e-4)
    assert set(truth["agent_id"]) == set(episode.agent_ids) and len(truth["x_m"]) == episode.mode.size


@pytest.mark.parametrize("georeferenced", [False, True])
@pytest.mark.parametrize("encoding", ["protobuf", "json", "cdr"])
def test_detections_of_unknown_origin_name_nobody(tmp_path: Path, encoding: Any, georeferenced: bool) -> None:
    config = dataclasses.replace(UNKNOWN, encoding=encoding, georeferenced=georeferenced)
    (path,) = simulate(tmp_path, config, QUIET).outputs
    log = open_log(path)
    topics = {channel.topic for channel in log.channels}
    assert topics == {"/detections", "/scene/obstacles", "/truth/agent_1", "/truth/agent_2", "/truth/agent_3"}
    episode = simulate_rendezvous(UNKNOWN.rendezvous, 3, 0)
    messages = [message.data for message in log.messages(["/detections"])]
    assert len(messages) == len(episode.detections) and (episode.detections.agent < 0).any()
    assert not any(b"agent_" in data for data in messages)
    (source,) = suggest_mapping(log.channels).detections
    assert source.topic == "/detections" and source.agent is None


def test_the_pipeline_gets_them_without_a_name(tmp_path: Path) -> None:
    found, _ = extracted(tmp_path, UNKNOWN)
    episode = simulate_rendezvous(UNKNOWN.rendezvous, 3, 0)
    assert found["agent_id"] == [None] * len(episode.detections)
    np.testing.assert_allclose(np.stack([found["x_m"], found["y_m"]], axis=-1), episode.detections.position_m, atol=6e-4)


def test_a_log_tells_of_goals_and_sites(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, num_episodes=8)
    paths = simulate(tmp_path, config, QUIET).outputs
    assert paths[2].name == "rendezvous-3-0002.mcap"
    for index, path in enumerate(paths):
        mission = {key: json.loads(value) for key, value in dict(open_log(path).metadata())["mission"].items()}
        episode = simulate_rendezvous(config.rendezvous, 3, index)
        assert (mission["step_s"], mission["map_side_m"], mission["is_origin_known"]) == (60.0, 30000.0, True)
        assert mission["all_goals_m"] == GOALS_M.tolist() and mission["all_sites_m"] == SITES_M.tolist()
        assert mission["goals_m"] == [goals.tolist() for goals in episode.goals_m]
        assert mission["is_meeting"] == (len(episode.goals_m[0]) == 2)
