"""Mission hypotheses that move over the first map: where each is at any time, and what it takes."""

import base64
from pathlib import Path

import numpy as np
import pytest
from fixtures.asked import asked_mission
from fixtures.mission import FRAME, START_NS, build_mission

from cadence.stories import Stories
from pipeline.report.maps import View
from pipeline.report.mission import load_mission
from pipeline.report.moving import kept_steps, moving_content
from pipeline.report.whole import whole_section
from pipeline.stories import Block, MissionStories

SIZE = (800, 460)
LARGE = 5e6
BLOCKS = (Block(0, 40, START_NS, 10**9), Block(40, 60, START_NS + 40 * 10**9, 5 * 10**9))


def wandering(num_stories: int = 6) -> MissionStories:
    """Two agents that wander, over steps of two lengths; the second comes late in every other story, in the first never."""
    time_ns = np.concatenate([block.time_ns for block in BLOCKS])
    position_m = np.cumsum(np.random.default_rng(1).normal(0, 40, (num_stories, 2, 60, 2)), axis=2)
    position_m[::2, 1, :15] = np.nan
    position_m[0, 1] = np.nan
    weight = np.full(num_stories, 1 / num_stories)
    stories = Stories((time_ns - START_NS) * 1e-9, position_m, weight, ("T0", "T1"))
    return MissionStories(FRAME, "patrol", START_NS, stories, BLOCKS)


def view_of(mission: MissionStories) -> View:
    return View(np.nan_to_num(mission.stories.position_m).reshape(-1, 2), 0.06, SIZE)


def read(content: dict, name: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(content[name]), kind)


def test_every_track_is_where_it_should_be_at_every_step() -> None:
    mission = wandering()
    view = view_of(mission)
    content = moving_content(mission, 6, view, SIZE, START_NS - 7 * 10**9, LARGE)
    time_s, counts = read(content, "time_s", "<f8"), read(content, "num_vertices", "<i4")
    assert content["num_stories"] == 6 and time_s[0] == 7.0
    steps, places = read(content, "step", "<i4"), read(content, "place", "<i2").reshape(-1, 2) / 16.0
    ends = np.cumsum(counts)
    tracks = [track for story in mission.stories.position_m for track in story if np.isfinite(track[:, 0]).any()]
    assert len(tracks) == len(counts) == 11 and ends[-1] == len(steps) == len(places)
    for track, begin, end in zip(tracks, ends - counts, ends, strict=True):
        own, there = steps[begin:end], np.flatnonzero(np.isfinite(track[:, 0]))
        assert own[0] == there[0] and own[-1] == there[-1], "no longer than the agent is part of the story"
        found = np.stack([np.interp(time_s[there], time_s[own], places[begin:end, axis]) for axis in (0, 1)], -1)
        assert np.linalg.norm(found - view.pixels(track[there]), axis=1).max() < 0.7 + 0.1


def test_who_rests_or_goes_evenly_takes_two_vertices_and_who_halts_takes_four() -> None:
    time_s = np.linspace(0, 10, 101)
    even = np.stack([50 * time_s, np.zeros(101)], -1)
    assert kept_steps(time_s, even, 0.5).tolist() == [0, 100]
    assert kept_steps(time_s[:1], even[:1], 0.5).tolist() == [0]
    halting = np.stack([np.interp(time_s, [0, 3, 6, 10], [0, 100, 100, 200]), np.zeros(101)], -1)
    assert kept_steps(time_s, halting, 0.5).tolist() == [0, 30, 60, 100], "the line is straight, the motion is not"


@pytest.mark.parametrize(("max_bytes", "fewest", "most"), [(1, 1, 1), (3e4, 2, 20), (LARGE, 40, 40)])
def test_fewer_stories_move_where_the_page_is_small(max_bytes: float, fewest: int, most: int) -> None:
    mission = wandering(40)
    content = moving_content(mission, 40, view_of(mission), SIZE, START_NS, max_bytes)
    assert fewest <= content["num_stories"] <= most
    size = sum(len(text) for text in content.values() if isinstance(text, str))
    assert max_bytes == 1 or size < 0.06 * max_bytes + 1500


def test_the_page_says_how_many_tracks_move(tmp_path: Path) -> None:
    section = whole_section(load_mission(asked_mission(tmp_path)), LARGE)
    assert "one of 30 of these tracks" in section and 'id="moving"' in section and len(section) < 60_000


def test_without_mission_hypotheses_nothing_moves(tmp_path: Path) -> None:
    assert whole_section(load_mission(build_mission(tmp_path)), LARGE) == ""
