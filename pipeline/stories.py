"""Mission hypotheses as files: `mission.parquet`, block by block, and back as `Stories`."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cadence.arrays import Float32s, Float64s, Int64s
from cadence.errors import InputError
from cadence.stories import Stories
from pipeline.tables import Frame, read_table, table_metadata
from schemas.tables import MISSION

MISSION_NAME = "mission.parquet"


@dataclass(frozen=True)
class Block:
    """Steps `first` to `stop` (excluded) of the stories' times, evenly spaced `step_ns` apart, the first at `start_ns`."""

    first: int
    stop: int
    start_ns: int
    step_ns: int

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def time_ns(self) -> Int64s:
        """Times of the steps."""
        return np.asarray(self.start_ns + self.step_ns * np.arange(len(self)), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class MissionStories:
    """The mission hypotheses of a log.

    start_ns  when `stories.time_s` is zero: the first step of the first block
    blocks    one behind the other, all steps of the stories
    """

    frame: Frame
    log_id: str
    start_ns: int
    stories: Stories
    blocks: tuple[Block, ...]

    def __post_init__(self) -> None:
        bounds = [0, *itertools.chain.from_iterable((block.first, block.stop) for block in self.blocks)]
        bounds.append(len(self.stories.time_s))
        if any(a != b for a, b in zip(bounds[::2], bounds[1::2], strict=True)):
            raise ValueError("MissionStories.blocks must hold every step once, one behind the other")

    @property
    def time_ns(self) -> Int64s:
        """Times of all steps [T]."""
        return np.concatenate([block.time_ns for block in self.blocks]) if self.blocks else np.zeros(0, dtype=np.int64)


def seconds_since(start_ns: int, blocks: Sequence[Block]) -> Float64s:
    """The times of all steps of the blocks as seconds since `start_ns`, as `Stories` has them."""
    return np.asarray(np.concatenate([block.time_ns - start_ns for block in blocks]) * 1e-9)


def write_stories(mission: MissionStories, directory: Path) -> None:
    """Write mission.parquet into a folder, a row group a block."""
    schema = MISSION.with_metadata(table_metadata("mission", mission.frame))
    with pq.ParquetWriter(directory / MISSION_NAME, schema, compression="zstd") as writer:
        for number, block in enumerate(mission.blocks):
            tables = list(_block_rows(mission, number, block))
            if tables:
                writer.write_table(pa.concat_tables(tables).cast(schema))


def _block_rows(mission: MissionStories, number: int, block: Block) -> Iterator[pa.Table]:
    """MISSION rows of one block, a table an agent that is part of it."""
    stories = mission.stories
    k = stories.num_hypotheses
    for agent, name in enumerate(stories.agent_ids):
        position = stories.position_m[:, agent, block.first : block.stop]
        is_there = ~np.isnan(position[..., 0])
        if not is_there.any():
            continue
        datum = np.round(position[is_there].mean(axis=0))
        columns = [
            pa.array([mission.log_id] * k, pa.string()),
            pa.array(np.full(k, number, np.int32)),
            pa.array([name] * k, pa.string()),
            pa.array(np.arange(k, dtype=np.int32)),
            pa.array(stories.weight),
            pa.array(np.full(k, block.start_ns)),
            pa.array(np.full(k, block.step_ns)),
            pa.array(np.full(k, datum[0])),
            pa.array(np.full(k, datum[1])),
            _lists(position - datum, len(block)),
            pa.nulls(k, MISSION.field("height_m").type) if stories.height_m is None
            else _heights(stories.height_m[:, agent, block.first : block.stop]),
        ]  # fmt: skip
        yield pa.Table.from_arrays(columns, schema=MISSION)


def _lists(position: Float64s, size: int) -> pa.Array:
    flat = pa.FixedSizeListArray.from_arrays(pa.array(position.astype(np.float32).reshape(-1)), 2)
    offsets = pa.array(np.arange(0, (len(position) + 1) * size, size, dtype=np.int32))
    return pa.ListArray.from_arrays(offsets, flat)


def _heights(height: Float64s) -> pa.Array:
    """Null where nothing is known of the agent's height in this block."""
    k, size = height.shape
    offsets = np.arange(0, (k + 1) * size, size, dtype=np.int32)
    lists = pa.ListArray.from_arrays(pa.array(offsets), pa.array(height.astype(np.float32).reshape(-1)))
    is_known = ~np.isnan(height).all(axis=1)
    return pc.if_else(pa.array(is_known), lists, pa.nulls(k, lists.type))


def read_stories(directory: Path, num_hypotheses: int | None = None) -> MissionStories:
    """The mission hypotheses of a mission directory; with `num_hypotheses` only the first of them, as if there were no others.

    Hypotheses are in no order, so that the first ones stand for all. Raises `InputError` where there are none, or none that
    can be read: an older format, or damage.
    """
    path = directory / MISSION_NAME
    if not path.is_file():
        raise InputError(f"{path}: not found; run cadence retrospect {directory} first, which draws the mission as a whole")
    table, frame = read_table(path, "mission")
    if table.schema.names != MISSION.names or not table.num_rows:
        raise InputError(f"{path}: does not hold the columns of mission hypotheses; run cadence retrospect with --force")
    if num_hypotheses is not None:
        table = table.filter(pc.less(table["hypothesis"], num_hypotheses))
    return _Read.of(table, path).mission(frame)


@dataclass(frozen=True, eq=False)
class _Read:
    """The table as one group of K rows for each block and agent."""

    table: pa.Table
    k: int
    path: Path

    @staticmethod
    def of(table: pa.Table, path: Path) -> "_Read":
        table = table.sort_by([("block", "ascending"), ("agent_id", "ascending"), ("hypothesis", "ascending")])
        k = int(pc.max(table["hypothesis"]).as_py()) + 1
        number = table["hypothesis"].to_numpy()
        if len(number) % k or (number != np.tile(np.arange(k), len(number) // k)).any():
            raise InputError(f"{path}: does not hold every hypothesis of each block; run cadence retrospect with --force")
        return _Read(table.combine_chunks(), k, path)

    def mission(self, frame: Frame) -> MissionStories:
        first = self.table.take(pa.array(np.arange(0, self.table.num_rows, self.k)))
        agent_ids = tuple(sorted(first["agent_id"].unique().to_pylist()))
        blocks, of_group = self._blocks(first)
        num_steps = blocks[-1].stop
        position = np.full((self.k, len(agent_ids), num_steps, 2), np.nan)
        has_height = self.table["height_m"].null_count < self.table.num_rows
        height = np.full((self.k, len(agent_ids), num_steps), np.nan) if has_height else None
        agent = pc.index_in(first["agent_id"], value_set=pa.array(agent_ids)).to_numpy()
        datum_m = np.stack([first["datum_x_m"].to_numpy(), first["datum_y_m"].to_numpy()], -1)
        column = self.table["position_m"].combine_chunks()
        flat: Float32s = column.flatten().flatten().to_numpy(zero_copy_only=False).reshape(-1, 2)
        end = 0
        for group, block in enumerate(blocks[number] for number in of_group):
            begin, end = end, end + self.k * len(block)
            part = flat[begin:end].reshape(self.k, -1, 2)
            position[:, agent[group], block.first : block.stop] = part + datum_m[group]
            if height is not None:
                height[:, agent[group], block.first : block.stop] = self._height(group, len(block))
        weight = self.table["weight"].to_numpy()[: self.k]
        start_ns = blocks[0].start_ns
        stories = Stories(seconds_since(start_ns, blocks), position, weight / weight.sum(), agent_ids, height)
        return MissionStories(frame, str(first["log_id"][0]), start_ns, stories, tuple(blocks))

    def _blocks(self, first: pa.Table) -> tuple[list[Block], Int64s]:
        """The blocks, and the block of each group."""
        number, group = np.unique(first["block"].to_numpy(), return_index=True)
        of_group = np.searchsorted(number, first["block"].to_numpy())
        length = pc.list_value_length(self.table["position_m"]).to_numpy()
        if (length != length[:: self.k][group][of_group].repeat(self.k)).any():
            raise InputError(f"{self.path}: rows of one block differ in length; run cadence retrospect with --force")
        start_ns, step_ns = first["start_ns"].to_numpy(), first["step_ns"].to_numpy()
        found, stop = [], 0
        for each in group:
            begin, stop = stop, stop + int(length[each * self.k])
            found.append(Block(begin, stop, int(start_ns[each]), int(step_ns[each])))
        return found, of_group

    def _height(self, group: int, size: int) -> Float64s:
        rows = self.table["height_m"].slice(group * self.k, self.k).to_pylist()
        return np.array([[np.nan] * size if row is None else row for row in rows], dtype=np.float64)
