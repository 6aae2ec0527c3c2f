import dataclasses

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cadence.errors import InputError
from cadence.stories import Stories
from pipeline.stories import MISSION_NAME, Block, MissionStories, read_stories, seconds_since, write_stories
from pipeline.tables import Frame, write_table
from schemas.tables import MISSION

START_NS = 1_700_000_000_123_456_789
BLOCKS = (
    Block(0, 4, START_NS, 10_000_000),
    Block(4, 7, START_NS + 100_000_000, 3_000_000_000),
    Block(7, 8, START_NS + 10_000_000_000, 1),
)


def mission(height: bool = False) -> MissionStories:
    generator = np.random.default_rng(0)
    position = generator.normal(4e6, 1e4, (5, 3, 8, 2))
    position[:, 1, :5] = np.nan  # comes later
    position[2:, 2, 5:] = np.nan  # in some hypotheses it is gone
    heights = np.full((5, 3, 8), np.nan)
    heights[:, 0] = generator.normal(1000.0, 10.0, (5, 8))
    weight = np.array([0.1, 0.2, 0.3, 0.15, 0.25])
    stories = Stories(seconds_since(START_NS, BLOCKS), position, weight, ("a", "b", "c"), heights if height else None)
    return MissionStories(Frame("map", 48.0, 11.0), "flight", START_NS, stories, BLOCKS)


@pytest.mark.parametrize("height", [False, True])
def test_what_is_written_is_read_back(tmp_path, height):
    written = mission(height)
    write_stories(written, tmp_path)
    read = read_stories(tmp_path)
    assert (read.frame, read.log_id, read.start_ns, read.blocks) == (written.frame, "flight", START_NS, BLOCKS)
    assert read.stories.agent_ids == written.stories.agent_ids
    np.testing.assert_allclose(read.stories.position_m, written.stories.position_m, atol=5e-3, rtol=0)
    np.testing.assert_array_equal(read.stories.weight, written.stories.weight)
    np.testing.assert_array_equal(read.stories.time_s, written.stories.time_s)
    np.testing.assert_array_equal(np.diff(read.time_ns[:5]), [10_000_000] * 3 + [70_000_000])
    if height:
        np.testing.assert_allclose(read.stories.height_m, written.stories.height_m, atol=1e-3, rtol=0)
    else:
        assert read.stories.height_m is None


def test_an_agent_has_rows_only_where_it_is_part_of_a_story(tmp_path):
    write_stories(mission(), tmp_path)
    table = pq.read_table(tmp_path / MISSION_NAME)
    assert table.schema.equals(MISSION)
    found = {(row["block"], row["agent_id"]) for row in table.select(["block", "agent_id"]).to_pylist()}
    assert found == {(0, "a"), (0, "c"), (1, "a"), (1, "b"), (1, "c"), (2, "a"), (2, "b"), (2, "c")}
    assert table.num_rows == len(found) * 5


def test_the_first_hypotheses_can_be_read_alone(tmp_path):
    written = mission()
    write_stories(written, tmp_path)
    read = read_stories(tmp_path, num_hypotheses=2).stories
    np.testing.assert_allclose(read.weight, [1 / 3, 2 / 3])
    np.testing.assert_allclose(read.position_m, written.stories.position_m[:2], atol=5e-3, rtol=0)


def test_blocks_hold_every_step_once():
    with pytest.raises(ValueError, match="every step once"):
        dataclasses.replace(mission(), blocks=BLOCKS[:2])


def test_where_there_are_none_one_line_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match="cadence retrospect") as raised:
        read_stories(tmp_path)
    assert "\n" not in str(raised.value)


def test_an_older_format_is_refused_in_one_line(tmp_path):
    write_stories(mission(), tmp_path)
    path = tmp_path / MISSION_NAME
    table = pq.read_table(path)
    meta = {**pq.read_schema(path).metadata, b"cadence.version": b"0"}
    pq.write_table(table.replace_schema_metadata(meta), path)
    with pytest.raises(InputError, match="version 0") as raised:
        read_stories(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("damage", ["columns", "empty", "row", "length"])
def test_what_is_not_whole_is_refused(tmp_path, damage):
    write_stories(mission(), tmp_path)
    table = pq.read_table(tmp_path / MISSION_NAME)
    if damage == "columns":
        table = table.drop_columns(["height_m"])
    elif damage == "empty":
        table = table.slice(0, 0)
    elif damage == "row":
        table = table.slice(1)
    else:
        rows = table["position_m"].to_pylist()
        rows[3] = rows[3][:-1]
        table = table.set_column(9, MISSION.field("position_m"), pa.array(rows, MISSION.field("position_m").type))
    write_table(table, tmp_path / MISSION_NAME, "mission", Frame("map"))
    with pytest.raises(InputError, match="cadence retrospect with --force"):
        read_stories(tmp_path)
