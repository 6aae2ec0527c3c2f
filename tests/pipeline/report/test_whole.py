"""The map of the whole mission: what it draws, what it says, and results that have no mission hypotheses."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from fixtures.asked import NUM_STEPS, STEP_NS, asked_mission
from fixtures.mission import FRAME, START_NS, build_mission

from cadence.errors import InputError
from cadence.stories import Stories
from pipeline.progress import Progress
from pipeline.report.config import ReportConfig
from pipeline.report.mission import Points, load_mission
from pipeline.report.stage import report
from pipeline.report.whole import whole_section
from pipeline.stories import Block, MissionStories, seconds_since, write_stories

QUIET = Progress(quiet=True)
LARGE = 5e6


def page(directory: Path) -> str:
    report(directory, ReportConfig(), QUIET)
    return (directory / "report.html").read_text(encoding="utf-8")


def lines(section: str, kind: str) -> list[np.ndarray]:
    """Lines [N, 2] of the map in pixels, not those of its legend."""
    drawn = section.partition("</svg>")[0]
    found = re.findall(rf'<polyline class="{kind}" points="([^"]*)"', drawn)
    return [np.array([point.split(",") for point in line.split()], dtype=float) for line in found]


def bent_mission(parent: Path, num_agents: int, num_stories: int = 40) -> Path:
    """Agents that turn at every step: no vertex of their lines can be left out."""
    directory = build_mission(parent)
    block = Block(0, NUM_STEPS, START_NS, STEP_NS)
    position_m = np.random.default_rng(0).normal(0, 1000, (num_stories, num_agents, NUM_STEPS, 2))
    names = tuple(f"T{number}" for number in range(num_agents))
    stories = Stories(seconds_since(START_NS, [block]), position_m, np.full(num_stories, 1 / num_stories), names)
    write_stories(MissionStories(FRAME, "patrol", START_NS, stories, (block,)), directory)
    return directory


def test_thirty_stories_of_each_agent_are_drawn_where_they_are(tmp_path: Path) -> None:
    section = whole_section(load_mission(asked_mission(tmp_path)), LARGE)
    drawn = lines(section, "past")
    assert len(drawn) == 30 * 2
    east, north = drawn[0], drawn[1]  # from (-1000, 0) to (1000, 0), and from (0, -1000) to (0, 1000)
    assert np.ptp(east[:, 1]) < 0.2 and np.ptp(north[:, 0]) < 0.2
    assert east[-1, 0] - east[0, 0] == pytest.approx(north[0, 1] - north[-1, 1], abs=0.3) and north[0, 1] > north[-1, 1]
    assert east.mean(axis=0) == pytest.approx(north.mean(axis=0), abs=0.2)
    assert section.count('class="obstacle"') >= 2 and lines(section, "truth") and lines(section, "way")
    assert section.partition("</svg>")[0].count('class="detection"') > 10
    assert ">T0</text>" in section and ">T1</text>" in section


def test_truth_within_the_reach_of_hypotheses_is_not_cut_off(tmp_path: Path) -> None:
    mission = load_mission(bent_mission(tmp_path, 1))
    ends_m = np.array([[0.0, -3000.0], [0.0, 3000.0]])  # one step in a thousand is as far away
    truth = Points(START_NS + np.array([0, STEP_NS]), np.array([0, 0]), ends_m)
    (line,) = lines(whole_section(dataclasses.replace(mission, truth=truth), LARGE), "truth")
    assert 0 < line[1, 1] < line[0, 1] < 460


def test_it_is_the_first_map_and_says_what_it_is(tmp_path: Path) -> None:
    directory = asked_mission(tmp_path)
    (directory / "retrospect.manifest.json").write_text(json.dumps({"summary": {"num_hypotheses": 200}, "config": {}}))
    content = page(directory)
    assert content.index("<h2>The whole mission</h2>") == content.index("<h2>", content.index("<h2>In short</h2>") + 1)
    assert "30 of 200 joint tracks, each given all detections of the mission" in content
    assert "of motion and obstacles alone: the network and evidence are not in them" in content


def test_where_obstacles_are_not_kept_or_not_known_it_says_motion_alone(tmp_path: Path) -> None:
    directory = asked_mission(tmp_path)
    manifest = directory / "infer.manifest.json"
    told = json.loads(manifest.read_text())
    told["config"]["guidance"] = {"mode": "none"}
    manifest.write_text(json.dumps(told))
    assert "They are of motion alone:" in whole_section(load_mission(directory), LARGE)


def test_results_without_mission_hypotheses_have_a_page_without_it(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    assert "<h2>The whole mission</h2>" not in page(directory)
    assert "mission.parquet" not in json.loads((directory / "report.manifest.json").read_text())["inputs"]


def test_new_mission_hypotheses_are_a_new_page(tmp_path: Path) -> None:
    directory = asked_mission(tmp_path)
    page(directory)
    assert report(directory, ReportConfig(), QUIET).status == "skipped"
    bent_mission(tmp_path, 2)
    assert report(directory, ReportConfig(), QUIET).status == "done"


def test_damage_is_one_line(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    (directory / "mission.parquet").write_bytes(b"no parquet")
    with pytest.raises(InputError, match=r"mission\.parquet"):
        report(directory, ReportConfig(), QUIET)


@pytest.mark.parametrize(("num_agents", "max_bytes", "num_stories"), [(2, LARGE, 30), (40, LARGE, 9), (2, 1e5, 3), (2, 1, 1)])
def test_fewer_stories_where_agents_are_many_or_the_page_is_small(
    tmp_path: Path, num_agents: int, max_bytes: float, num_stories: int
) -> None:
    section = whole_section(load_mission(bent_mission(tmp_path, num_agents)), max_bytes)
    assert f"{num_stories} joint tracks" in section
    assert len(lines(section, "past")) == num_stories * num_agents
    assert num_stories == 1 or len(section) < 2 * 0.08 * max_bytes + 30_000


def test_an_agent_that_is_no_part_of_a_story_is_not_drawn_in_it(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    block = Block(0, NUM_STEPS, START_NS, STEP_NS)
    position_m = np.random.default_rng(0).normal(0, 1000, (4, 2, NUM_STEPS, 2))
    position_m[0, 1] = np.nan
    position_m[:, 0, :40] = np.nan
    stories = Stories(seconds_since(START_NS, [block]), position_m, np.full(4, 0.25), ("T0", "T1"))
    write_stories(MissionStories(FRAME, "patrol", START_NS, stories, (block,)), directory)
    section = whole_section(load_mission(directory), LARGE)
    assert len(lines(section, "past")) == 7 and "nan" not in section
