"""docs/sql.md: its views open what is in a mission directory, and its ten questions are answered as numpy answers them."""

import re
from pathlib import Path

import duckdb
import numpy as np
import pytest
from fixtures.mission import AGENT_IDS, build_mission

from cadence.stories import Stories
from pipeline.results import read_hypothesis_tables
from pipeline.stories import Block, MissionStories, read_stories, write_stories
from pipeline.tables import Frame, read_table

PAGE = Path(__file__).resolve().parents[3] / "docs" / "sql.md"
START_NS = 1_700_000_000_000_000_000
PLACE, RADIUS_M = np.array([1560.0, -170.0]), 60.0
BLOCKS = re.findall(r"^```sql\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """The answers of the page's questions on a mission of two agents, and what they are about."""
    directory = build_mission(tmp_path_factory.mktemp("sql"))
    time_ns = np.concatenate([np.arange(60) * 10**9, 60 * 10**9 + np.arange(20) * 2_500_000_000])
    rng = np.random.default_rng(5)
    base = np.stack([1500 + 3 * time_ns * 1e-9, -170 + 0 * time_ns], -1)
    position = base + 45 * rng.normal(size=(40, 2, 1, 2)) + np.cumsum(rng.normal(size=(40, 2, len(time_ns), 2)), axis=2)
    position[::3, 1, :7] = np.nan
    weight = rng.dirichlet(np.full(40, 2.0))
    stories = Stories(time_ns * 1e-9, position, weight, AGENT_IDS)
    blocks = (Block(0, 60, START_NS, 10**9), Block(60, 80, START_NS + 60 * 10**9, 2_500_000_000))
    write_stories(MissionStories(Frame("map"), "patrol", START_NS, stories, blocks), directory)
    database = duckdb.connect()
    views, *questions = BLOCKS
    assert len(questions) == 10
    database.execute(views.replace(" '", f" '{directory}/"))
    return directory, read_stories(directory).stories, [database.execute(question).fetchall() for question in questions]


def inside(stories: Stories) -> np.ndarray:
    """Which steps [K, A, T] of which stories lie about the place."""
    with np.errstate(invalid="ignore"):
        return np.linalg.norm(stories.position_m - PLACE, axis=-1) <= RADIUS_M


def test_where_how_sure_and_how_likely_inside(asked):
    _, stories, (where, there, *_) = asked
    step = 20
    for agent in range(2):
        position, weight = stories.position_m[:, agent, step], stories.weight
        mean = weight @ position
        spread = np.sqrt(weight @ ((position - mean) ** 2).sum(-1))
        assert where[agent] == (AGENT_IDS[agent], *(pytest.approx(value, abs=0.01) for value in (*mean, spread)))
        assert there[agent][1] == pytest.approx(weight @ inside(stories)[:, agent, step])
    assert 0 < there[0][1] < 1


def test_entry_its_time_and_the_stay(asked):
    _, stories, (_, _, entered, first, stay, *_) = asked
    held = inside(stories)
    step_s = np.diff(stories.time_s)
    for agent in range(2):
        came = held[:, agent].any(axis=1)
        assert entered[agent][1] == pytest.approx(stories.weight @ came)
        order = np.argsort(held[came, agent].argmax(axis=1), kind="stable")
        time_s = stories.time_s[held[came, agent].argmax(axis=1)[order]]
        share = np.cumsum(stories.weight[came][order]) / stories.weight[came].sum()
        expected = [START_NS + round(time_s[np.searchsorted(share, level)] * 1e9) for level in (0.05, 0.5, 0.95)]
        assert [int(np.datetime64(moment, "ns").astype(np.int64)) for moment in first[agent][1:]] == expected
        assert stay[agent][1] == pytest.approx(stories.weight @ (held[:, agent, :-1] * step_s).sum(axis=1))


def test_meeting_and_way(asked):
    _, stories, (*_, met, gone, _, _, _) = asked
    with np.errstate(invalid="ignore"):
        near = (np.linalg.norm(stories.position_m[:, 0] - stories.position_m[:, 1], axis=-1) <= 100).any(axis=1)
    assert met == [(*AGENT_IDS, pytest.approx(stories.weight @ near))] and 0 < met[0][2] < 1
    legs = np.nansum(np.linalg.norm(np.diff(stories.position_m, axis=2), axis=-1), axis=2)
    assert [row[1] for row in gone] == pytest.approx((stories.weight @ legs).tolist(), rel=1e-5)


def test_gaps_windows_and_forecasts(asked):
    directory, stories, (*_, gaps, amiss, ahead) = asked
    table, _ = read_table(directory / "detections.parquet", "detections")
    for agent, row in zip(AGENT_IDS, gaps, strict=True):
        times = np.sort(
            [t for t, name in zip(table["time_ns"].to_pylist(), table["agent_id"].to_pylist(), strict=True) if name == agent]
        )
        assert row[1] == np.diff(times).max() / 1e9
    assert [(row[0], row[2], row[3], row[4]) for row in amiss] == [(5, "T1", "no_detections", "widen the history")]
    windows = read_hypothesis_tables(directory).windows
    sums = np.zeros(2)
    for window in windows:  # T0, the seconds from 10 to below 20 ahead
        agent = window.agents[0]
        for ahead_s in range(10, 20):
            since_s = (window.origin_ns - START_NS) / 1e9 + ahead_s
            if np.abs(stories.time_s - since_s).min() > 1e-6:
                continue
            position = stories.at(np.array([since_s]))[:, 0, 0]
            said = agent.position_m[:, window.origin_index + ahead_s] + np.array(agent.datum_m)
            away = np.linalg.norm(said - stories.weight @ position, axis=-1)
            sums += (window.weight @ away, window.weight.sum())
    assert next(row[2] for row in ahead if row[:2] == ("T0", 10)) == pytest.approx(sums[0] / sums[1], rel=1e-4)
