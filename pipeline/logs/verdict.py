"""What a walk has found, compared with what the file says of itself."""

from pipeline.logs.file_walk import MAX_SMALL_BYTES, FileWalk
from pipeline.logs.plan import Loss, Plan
from pipeline.logs.plan_builder import Tally
from pipeline.logs.records import HEAD
from pipeline.logs.summary import Summary, prefer_index, unconfirmed


def compare_checksum(plan: Plan, stated: int, found: int | None) -> None:
    """Compare the checksum over all data that their end mark states (0: none) with the one that was found."""
    if stated not in (0, found) and not plan.losses:
        place = "outside the chunks" if plan.has_checksums else "somewhere"
        plan.doubts.append(f"The checksum over all data does not match: something was changed {place}.")
    has_loose = any(block.kind == "loose" for block in plan.blocks)
    plan.has_checksums = stated != 0 or (plan.has_checksums and not has_loose)


def compare_summary(plan: Plan, tally: Tally, walk: FileWalk) -> None:
    """Put into the plan in what the walk, which is over, differs from the summary, and what nothing can confirm."""
    summary = plan.summary
    if not plan.reached_end and not plan.losses:
        plan.doubts.append("The file ends without its end mark: the recording was cut off.")
    if tally.num_timeless:
        plan.doubts.append(f"{tally.num_timeless} messages have log times after the year 2262 and cannot be used.")
    if tally.num_bad_indexes:
        plan.remarks.append(f"{tally.num_bad_indexes} chunks differ from their message indexes, which were not used.")
    if tally.num_unknown and (summary is None or summary.statistics is None):
        plan.doubts.append(f"{tally.num_unknown} unknown records were skipped; no statistics tell whether any mattered.")
    if summary is None:
        _confirm_definitions(plan, tally, walk)
    else:
        _compare_with(summary, plan)


def _compare_with(summary: Summary, plan: Plan) -> None:
    plan.doubts += prefer_index("Channel", plan.channels, summary.channels)
    plan.doubts += prefer_index("Schema", plan.schemas, summary.schemas)
    seen = {loss.offset for loss in plan.losses} | {block.offset - HEAD.size for block in plan.blocks if block.kind == "chunk"}
    for offset, index in summary.chunks.items():
        if offset not in seen and index.message_index_offsets:
            span = (index.message_start_time, index.message_end_time)
            plan.losses.append(Loss(offset, "the chunk that the index names is not there", span))


def _confirm_definitions(plan: Plan, tally: Tally, walk: FileWalk) -> None:
    """Without checksums the names of channels are believed only where a damaged index repeats them."""
    if plan.reached_end and not plan.has_checksums:
        tail = walk.read(walk.position, min(walk.size - walk.position, MAX_SMALL_BYTES))
        if num := len(unconfirmed(tally.definitions, tail)):
            words = "of channels or schemas are not repeated by the damaged index, and no checksum covers them"
            plan.doubts.append(f"{num} definitions {words}.")
