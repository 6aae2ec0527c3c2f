"""Mission hypotheses in the side file: the first of them, block by block, and as whole lines of their own."""

import json
from pathlib import Path

import numpy as np
import pytest
from fixtures.mission import GEOREFERENCED, START_NS, build_mission
from fixtures.side_files import assert_near, dequantized
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from test_export import QUIET, messages

from cadence.stories import Stories
from pipeline.export.config import ExportConfig
from pipeline.export.stage import export
from pipeline.stories import Block, MissionStories, write_stories
from schemas.channels import message_class

NUM, SHOWN, STEP_NS = 40, 30, 2_000_000_000
BLOCKS = (Block(0, 50, START_NS, STEP_NS), Block(50, 80, START_NS + 50 * STEP_NS, 2 * STEP_NS))
LATE = 20
"""Where the second agent begins, in every third story."""


@pytest.fixture(scope="module")
def told(tmp_path_factory) -> tuple[Stories, Path]:
    directory = build_mission(tmp_path_factory.mktemp("told"), frame=GEOREFERENCED)
    time_ns = np.concatenate([block.time_ns for block in BLOCKS])
    rng = np.random.default_rng(5)
    position = np.cumsum(rng.normal(size=(NUM, 2, 80, 2)), axis=2) + 4e-9 * (time_ns - START_NS)[:, None]
    position[::3, 1, :LATE] = np.nan
    position[1, 1] = np.nan
    height = 300.0 + np.cumsum(rng.normal(size=(NUM, 2, 80)), axis=2)
    height[:, 1] = np.nan
    stories = Stories((time_ns - START_NS) * 1e-9, position, np.full(NUM, 1.0 / NUM), ("T0", "T1"), height)
    write_stories(MissionStories(GEOREFERENCED, "patrol", START_NS, stories, BLOCKS), directory)
    export(directory, ExportConfig(), QUIET)
    return stories, directory


def test_a_message_a_block_and_agent_holds_the_first_hypotheses(told):
    stories, directory = told
    found = messages(directory, "/cadence/mission", message_class("cadence.MissionHypotheses"))
    assert [(m.block, m.agent_id) for _, m in found] == [(0, "T0"), (0, "T1"), (1, "T0"), (1, "T1")]
    for time_ns, message in found:
        block, agent = BLOCKS[message.block], stories.agent(message.agent_id)
        assert time_ns == message.start_ns == message.timestamp.ToNanoseconds() == block.start_ns
        assert (message.step_ns, message.num_steps, list(message.hypothesis)) == (block.step_ns, len(block), list(range(SHOWN)))
        assert sum(message.weight) == pytest.approx(1.0)
        datum = np.array([message.datum_x_m, message.datum_y_m])
        true = (stories.position_m[:SHOWN, agent, block.first : block.stop] - datum).astype(np.float32)
        weight = np.array(message.weight, dtype=np.float32)
        if (message.block, message.agent_id) == (0, "T1"):  # where tracks begin within a block
            assert not message.HasField("position")
            back = np.array(message.position_m, dtype=np.float32).reshape(true.shape)
            assert np.array_equal(np.isnan(back), np.isnan(true)) and np.nanmax(np.abs(back - true)) < 1e-4
        else:
            assert_near(dequantized(message.position, 2), true, weight)
        assert message.HasField("height") == (message.agent_id == "T0")
        if message.HasField("height"):
            high = stories.height_m[:SHOWN, agent, block.first : block.stop, None].astype(np.float32)
            assert_near(dequantized(message.height, 1), high, weight)


def test_whole_lines_stand_on_a_topic_of_their_own_from_the_beginning(told):
    stories, directory = told
    ((time_ns, update),) = messages(directory, "/cadence/mission_scene", SceneUpdate)
    assert time_ns == START_NS and [entity.id for entity in update.entities] == ["mission/T0", "mission/T1"]
    first, second = update.entities
    assert len(first.lines) == SHOWN and len(second.lines) == SHOWN - 1, "one story has no second agent"
    reach = float(np.ptp(stories.position_m[:SHOWN, 0], axis=(0, 1)).max())
    ends = {(line.points[-1].x, line.points[-1].y) for line in first.lines}
    true = stories.position_m[:SHOWN, 0, -1]
    assert all(np.linalg.norm(true - end, axis=-1).min() < reach / 512 for end in ends)
    assert all(280.0 < point.z < 340.0 for line in first.lines for point in line.points)
    starts = {(line.points[0].x, line.points[0].y) for line in second.lines}
    begun = np.where(np.isnan(stories.position_m[:, 1, :1, 0]), stories.position_m[:, 1, LATE], stories.position_m[:, 1, 0])
    assert all(np.nanmin(np.linalg.norm(begun - start, axis=-1)) < reach / 512 for start in starts)


def test_they_are_switched_off_and_change_nothing_else(told, tmp_path):
    _, directory = told
    for name in ("layout", "layout.legacy"):
        layout = json.loads((directory / f"patrol.{name}.json").read_text())
        assert '"/cadence/mission_scene": {"visible": false}' in json.dumps(layout)
    bare = build_mission(tmp_path, frame=GEOREFERENCED)
    export(bare, ExportConfig(), QUIET)
    assert not messages(bare, "/cadence/mission_scene", SceneUpdate)
    for topic in ("/cadence/scene", "/cadence/present"):
        with_them, without = (messages(each, topic, SceneUpdate) for each in (directory, bare))
        assert with_them == without and with_them, "the windows' scene must not know the future"
