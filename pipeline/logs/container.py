"""What the container of a log lacks, though every message can be read: index, statistics, order of its chunks."""

from collections.abc import Sequence
from pathlib import Path

from mcap.records import ChunkIndex

from pipeline.logs.packed import unpacked
from pipeline.logs.summary import Summary, read_summary


def container_remarks(path: Path) -> tuple[str, ...]:
    """One sentence each, from the end of the file alone; OSError is the caller's.

    A damaged end is not remarked on here: the health of the log says what is wrong with it.
    """
    plain = unpacked(path)
    with plain.open("rb") as file:
        summary, _ = read_summary(file, 0, plain.stat().st_size)
    if summary is None:
        return ()
    if not summary.statistics and not summary.chunks and not summary.channels:
        return ("There is no index at the end of the file: every reader has to go through all of it.",)
    return tuple(_remarks(summary))


def _remarks(summary: Summary) -> list[str]:
    chunks = [summary.chunks[offset] for offset in sorted(summary.chunks)]
    found = []
    if summary.statistics is None:
        found.append("The file has no statistics: a message that is missing as a whole could not be noticed.")
    elif summary.statistics.chunk_count and not chunks:
        found.append("Its chunks are not indexed: every reader has to go through all of it.")
    elif not summary.statistics.chunk_count and summary.statistics.message_count:
        found.append("Its messages are not in chunks: they are neither compressed nor indexed by time.")
    num_unindexed = sum(1 for chunk in chunks if not chunk.message_index_length)
    if num_unindexed:
        found.append(f"{num_unindexed} of {len(chunks)} chunks have no message index: to read one topic all must be unpacked.")
    num_overlaps = num_overlapping(chunks)
    if num_overlaps:
        words = "begin before an earlier one ends: reading in the order of time takes more memory"
        found.append(f"{num_overlaps} of {len(chunks)} chunks {words}.")
    return found


def num_overlapping(chunks: Sequence[ChunkIndex]) -> int:
    """Chunks, in the order of the file, that begin before the end of some earlier one. Touching ones do not overlap."""
    latest, count = -1, 0
    for chunk in chunks:
        count += chunk.message_start_time < latest
        latest = max(latest, chunk.message_end_time)
    return count
