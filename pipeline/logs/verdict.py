"""What a walk has found, compared with what the file says of itself."""

from dataclasses import replace

from mcap.records import Statistics

from pipeline.counted import counted
from pipeline.logs.chunk_checks import compare_chunks, leave_out_repeated
from pipeline.logs.file_walk import FileWalk
from pipeline.logs.plan import Plan
from pipeline.logs.plan_builder import Tally
from pipeline.logs.summary import find_summary, prefer_index, stated_data_end, stated_statistics, unconfirmed
from pipeline.logs.tail import Tail


def judge(plan: Plan, tally: Tally, tail: Tail, walk: FileWalk, fault: str) -> None:
    """Put into the plan in what the walk, which is over, differs from what the file says, and what nothing can confirm.

    `fault` says why the summary was not found where it should be; empty where it was.
    """
    _compare_end(plan, tail)
    if tally.num_timeless:
        found = counted(tally.num_timeless, "message has a log time", "messages have log times")
        plan.doubts.append(f"{found} after the year 2262 and cannot be used.")
    if tally.num_bad_indexes:
        found = counted(tally.num_bad_indexes, "chunk differs from its", "chunks differ from their")
        plan.remarks.append(f"{found} message indexes, which were not used.")
    if plan.summary is None and tail.mark is not None:
        plan.summary = find_summary(walk.file, walk.begin, walk.end, tail.mark.end)
    plan.statistics = plan.summary.statistics if plan.summary is not None else _testimony(tail, walk)
    leave_out_repeated(plan, tally, walk.file)
    if tally.num_unknown and plan.statistics is None:
        plan.doubts.append(f"{tally.num_unknown} unknown records were skipped; no statistics tell whether any mattered.")
    if plan.summary is not None:
        plan.doubts += prefer_index("Channel", plan.channels, plan.summary.channels)
        plan.doubts += prefer_index("Schema", plan.schemas, plan.summary.schemas)
        compare_chunks(plan, tally, plan.summary)
    elif plan.reached_end and not plan.has_checksums:
        _confirm_definitions(plan, tally, tail)
    if fault:
        _compare_place(plan, tail, walk, fault)
    _compare_statistics(plan, tally)


def _compare_end(plan: Plan, tail: Tail) -> None:
    """Whether the data end as they should, and have the checksum that their end mark states."""
    plan.reached_end = tail.is_open
    if not tail.is_open:
        if not plan.losses:
            plan.doubts.append("The file ends without its end mark: the recording was cut off.")
        return
    del plan.losses[tail.num_losses :]  # no message is lost behind the data
    if tail.mark is None:
        plan.doubts.append("The end mark of the data is missing.")
        return
    if tail.mark.stated not in (0, tail.mark.found) and not plan.losses and not plan.doubts:
        place = "outside the chunks" if plan.has_checksums else "somewhere"
        plan.doubts.append(f"The checksum over all data does not match: something was changed {place}.")
    has_loose = any(block.kind == "loose" for block in plan.blocks)
    plan.has_checksums = tail.mark.stated != 0 or (plan.has_checksums and not has_loose)


def _testimony(tail: Tail, walk: FileWalk) -> Statistics | None:
    """The statistics that were met behind the data or lie where the footer says, if they do not contradict themselves."""
    stated = tail.testimony.statistics or stated_statistics(walk.file, walk.begin, walk.end)
    if stated is None or sum(stated.channel_message_counts.values()) != stated.message_count:
        return None
    # Of what no checksum covers the sum alone was confirmed, by its terms.
    return replace(stated, channel_message_counts={}) if stated.message_start_time <= stated.message_end_time else None


def _confirm_definitions(plan: Plan, tally: Tally, tail: Tail) -> None:
    """Without checksums the names of channels are believed only where a damaged index repeats them."""
    if num := len(unconfirmed(tally.definitions, tail.definitions)):
        words = "of channels or schemas are not repeated by the damaged index, and no checksum covers them"
        plan.doubts.append(f"{num} definitions {words}.")


def _compare_place(plan: Plan, tail: Tail, walk: FileWalk, fault: str) -> None:
    """Compare where the data end with what the footer says: bytes that were added or lost have moved the end."""
    stated = stated_data_end(walk.file, walk.begin, walk.end)
    shift = 0 if tail.mark is None or stated is None else tail.mark.end - stated
    if plan.summary is None:
        plan.remarks.append(fault)
    if not shift:
        return
    where = f"The data end {abs(shift)} bytes {'behind' if shift > 0 else 'before'} the place that the file states"
    if plan.is_counted() and not plan.losses:
        plan.remarks.append(f"{where}; so many messages as it counts were found.")
    else:
        plan.doubts.append(f"{where}: bytes {'were added' if shift > 0 else 'are missing'}.")


def _compare_statistics(plan: Plan, tally: Tally) -> None:
    """Compare counts and times of what was found with the statistics; the messages of channels are left to the health."""
    stated = plan.statistics
    if stated is None or plan.losses:
        return
    numbers = {
        "chunks": (stated.chunk_count, len(tally.chunks)),
        "attachments": (stated.attachment_count, tally.num_attachments),
        "metadata records": (stated.metadata_count, len(plan.metadata_spans)),
    }
    for name, (expected, num_found) in numbers.items():
        if expected != num_found:
            plan.remarks.append(f"The statistics of the file count {expected} {name}; {num_found} were found.")
    if plan.summary is not None and plan.is_counted() and not plan.has_checksums and not tally.num_timeless:
        spans = [(block.start_ns, block.end_ns) for block in plan.blocks if block.num_messages]
        found = (min(start for start, _ in spans), max(end for _, end in spans)) if spans else (0, 0)
        if spans and found != (stated.message_start_time, stated.message_end_time):
            plan.doubts.append("The first or the last log time differs from the statistics of the file: a time was changed.")
