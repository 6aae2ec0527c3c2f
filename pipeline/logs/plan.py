"""What a walk over a log has found: the stretches that hold messages, the definitions, and what is lost."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from mcap import records

from pipeline.logs.rows import Rows
from pipeline.logs.summary import Summary


@dataclass(frozen=True)
class Block:
    """A stretch of the file which holds messages: the body of a chunk record, or records outside chunks.

    offset, length  bytes in the file; for loose and torn records they begin with a record head, for chunks with their fields
    kind            a "cut" chunk is the last thing in a file that ends inside it, "torn" are the records of a chunk without
                    compression and checksum that is damaged
    num_messages    by channel id
    index_length    bytes of the message indexes behind a chunk, where they are known to agree with it, as far as it is torn
                    with what is left of it; else 0
    """

    offset: int
    length: int
    kind: Literal["chunk", "cut", "torn", "loose"]
    start_ns: int
    end_ns: int
    num_messages: Mapping[int, int]
    index_length: int = 0


@dataclass(frozen=True)
class Loss:
    """A part of the file that could not be used; `span_ns` and `num_messages` where they are known."""

    offset: int
    reason: str
    span_ns: tuple[int, int] | None = None
    num_messages: int | None = None


@dataclass
class Plan:
    """What a recording holds and what it has lost; `begin` and `end` are its bytes in the file."""

    begin: int = 0
    end: int = 0
    blocks: list[Block] = field(default_factory=list)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    metadata_spans: list[tuple[int, int]] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    """Faults by which no message is lost."""
    doubts: list[str] = field(default_factory=list)
    """Faults by which messages may be lost or wrong, without a place in the file."""
    summary: Summary | None = None
    statistics: records.Statistics | None = None
    """What the file says that it holds; None where it does not, or cannot be believed."""
    repeated: Counter[int] = field(default_factory=Counter)
    """Messages by channel id that are not in the blocks because another recording of the file holds them, too."""
    library: str = ""
    reached_end: bool = False
    has_checksums: bool = True

    def counts(self) -> Counter[int]:
        """Messages in the blocks by channel id, also those of channels without definition."""
        counts: Counter[int] = Counter()
        for block in self.blocks:
            counts.update(block.num_messages)
        return counts

    def is_counted(self) -> bool:
        """Whether the file says how many messages each channel has, and so many were found."""
        stated, found = self.statistics, self.counts() + self.repeated
        if stated is None or stated.message_count != found.total():
            return False
        return not stated.channel_message_counts or +Counter(stated.channel_message_counts) == found


@dataclass
class LooseRun:
    """Consecutive records outside chunks, until they make a block."""

    begin: int = -1
    end: int = -1
    first: int = 2**64
    last: int = -1
    counts: Counter[int] = field(default_factory=Counter)

    def add(self, begin: int, end: int, rows: Rows) -> None:
        """Take the messages, at least one, in the bytes [begin, end)."""
        if self.begin < 0:
            self.begin = begin
        self.end = end
        self.counts.update(rows.counts())
        first, last = rows.span_ns()
        self.first, self.last = min(self.first, first), max(self.last, last)

    def block(self) -> Block:
        """The block of the records so far."""
        return Block(self.begin, self.end - self.begin, "loose", self.first, self.last, dict(self.counts))


def is_span(start: int, end: int) -> bool:
    """Whether times from the header of a chunk, which no checksum covers, can be a span."""
    return 0 < start <= end < 2**63
