"""The plan of a log by its indexes alone, for a file that was checked as a whole before: no chunk is unpacked.

What the index does not account for completely is left to the walk (see `salvage`).
"""

from collections import Counter
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap import records
from mcap.opcode import Opcode

from pipeline.logs.packed import unpacked
from pipeline.logs.plan import Block, Plan
from pipeline.logs.records import HEAD, MAGIC, MAX_TIME_NS, DamagedRecord, library_of, parse_message_index, walk
from pipeline.logs.summary import Summary, read_summary


def plan_by_index(path: Path) -> Plan | None:
    """The plan of the file; None where its summary or message indexes are absent or incomplete."""
    try:
        plain = unpacked(path)
        with plain.open("rb") as file:
            size = plain.stat().st_size
            summary, fault = read_summary(file, 0, size)
            if summary is None or fault or summary.statistics is None:
                return None
            return _plan(file, size, summary, summary.statistics)
    except (DamagedRecord, OSError):  # the walk says what is wrong
        return None


def _plan(file: BinaryIO, size: int, summary: Summary, statistics: records.Statistics) -> Plan | None:
    plan = Plan(
        end=size, channels=summary.channels, schemas=summary.schemas, summary=summary, statistics=statistics, reached_end=True
    )
    plan.library = _library(file)
    for index in summary.chunks.values():
        block = _block(file, index)
        if block.num_messages:
            plan.blocks.append(block)
    plan.metadata_spans = sorted(summary.metadata_spans)
    counts = plan.counts()
    is_complete = (
        len(summary.chunks) == statistics.chunk_count
        and len(plan.channels) == statistics.channel_count
        and len(plan.schemas) == statistics.schema_count
        and len(plan.metadata_spans) == statistics.metadata_count
        and counts == +Counter(statistics.channel_message_counts)
        and counts.keys() <= plan.channels.keys()
        and counts.total() == statistics.message_count
        and {channel.schema_id for channel in plan.channels.values()} <= plan.schemas.keys() | {0}
    )
    return plan if is_complete else None


def _block(file: BinaryIO, index: records.ChunkIndex) -> Block:
    """The block of one chunk, by the message indexes behind it."""
    file.seek(index.chunk_start_offset + index.chunk_length)
    data = file.read(index.message_index_length)
    counts: Counter[int] = Counter()
    times = []
    for opcode, begin, end in walk(data):
        if opcode != Opcode.MESSAGE_INDEX:
            raise DamagedRecord("there is no message index where the chunk's index says")
        channel_id, entries = parse_message_index(data[begin:end])
        if len(entries):
            counts[channel_id] += len(entries)
            times.append(entries["log_time"])
    together = np.concatenate(times) if times else np.empty(0, np.uint64)
    first, last = (int(together.min()), int(together.max())) if times else (2**64, -1)
    if last > MAX_TIME_NS:
        raise DamagedRecord("a log time does not fit into int64")
    body = index.chunk_start_offset + HEAD.size
    return Block(body, index.chunk_length - HEAD.size, "chunk", first, last, dict(counts), index.message_index_length)


def _library(file: BinaryIO) -> str:
    """Who wrote the file, from its first record."""
    file.seek(len(MAGIC))
    opcode, length = HEAD.unpack(file.read(HEAD.size))
    if opcode != Opcode.HEADER or length > 2**16:
        raise DamagedRecord("the file does not begin with its header")
    return library_of(file.read(length))
