"""The chunks that a walk has found beside those that the index names, and chunks that stand in a file twice."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import BinaryIO, Final

from mcap.records import ChunkIndex

from pipeline.logs.file_walk import is_same
from pipeline.logs.plan import Block, Loss, Plan
from pipeline.logs.plan_builder import ChunkFacts, Tally
from pipeline.logs.records import HEAD
from pipeline.logs.summary import Summary

_ABSENT: Final = "the chunk that the index names is not there"
_Signature = tuple[int, int, int]


def compare_chunks(plan: Plan, tally: Tally, summary: Summary) -> None:
    """Note as lost what the index names and the walk has not found, with its time span.

    Where the summary does not lie where it should, chunks lie elsewhere, too: they are known by their lengths and times.
    """
    known = {loss.offset: number for number, loss in enumerate(plan.losses)}
    unnamed = Counter(map(_signature, tally.chunks.values()))
    for offset, index in sorted(summary.chunks.items()):
        signature, found = _signature_of(index), tally.chunks.get(offset)
        if unnamed[signature] if summary.shift else found is not None and _signature(found) == signature:
            unnamed[signature] -= 1
            continue
        span = index.message_start_time, index.message_end_time
        number = known.get(offset, known.get(offset + summary.shift))
        if number is not None:
            plan.losses[number] = replace(plan.losses[number], span_ns=span)
        elif index.message_index_offsets:
            is_other = found is not None and not summary.shift
            reason = "another chunk lies where the index names this one" if is_other else _ABSENT
            plan.losses.append(Loss(offset, reason, span))


def leave_out_repeated(plan: Plan, tally: Tally, file: BinaryIO) -> None:
    """Take the messages of chunks once that stand in the recording more often than its index names them.

    Where no index names chunks, the statistics tell whether the recorder wrote one twice.
    """
    named = Counter(map(_signature_of, plan.summary.chunks.values() if plan.summary else ()))
    is_counted = plan.statistics is not None and plan.counts().total() <= plan.statistics.message_count
    surplus, left_out = set(), []
    for block, first, count in _repeated(file, [block for block in plan.blocks if block.kind == "chunk"]):
        if named[_signature(tally.chunks[first.offset - HEAD.size])] >= count:
            continue
        where = f"At byte {block.offset - HEAD.size}: the chunk of byte {first.offset - HEAD.size} stands there once more"
        if is_counted and not named:
            plan.doubts.append(f"{where}; its messages are taken again, as the statistics count them.")
        else:
            surplus.add(block.offset)
            left_out.append(f"{where}; its {sum(block.num_messages.values())} messages are taken once.")
    plan.blocks = [block for block in plan.blocks if block.offset not in surplus]
    if plan.is_counted():
        plan.remarks += left_out
    else:
        plan.doubts += left_out


def leave_out_shared(plans: Sequence[Plan], file: BinaryIO) -> None:
    """Take messages once that stand in several recordings of one file: one of them is a copy of the other, or a part of it."""
    owners = {block.offset: plan for plan in plans for block in plan.blocks}
    shared: dict[int, set[int]] = {}
    for block, first, _ in _repeated(file, [block for plan in plans for block in plan.blocks]):
        plan, original = owners[block.offset], owners[first.offset]
        if plan is not original and all(plan.channels.get(i) == original.channels.get(i) for i in block.num_messages):
            shared.setdefault(plan.begin, set()).add(block.offset)
            plan.repeated.update(block.num_messages)
    for plan in plans:
        if offsets := shared.get(plan.begin):
            plan.blocks = [block for block in plan.blocks if block.offset not in offsets]
            plan.remarks.append(
                f"{plan.repeated.total()} of its messages stand in an earlier recording, too; they are taken once."
            )


def _repeated(file: BinaryIO, blocks: Iterable[Block]) -> Iterator[tuple[Block, Block, int]]:
    """Each block whose bytes stand in the file already, the block that holds them first, and the how many-th it is."""
    seen: dict[tuple[int, int, int], list[Block]] = {}
    for block in blocks:
        before = seen.setdefault((block.length, block.start_ns, block.end_ns), [])
        if before and is_same(file, before[0].offset, block.offset, block.length):
            yield block, before[0], len(before) + 1
        before.append(block)


def _signature_of(index: ChunkIndex) -> _Signature:
    return index.chunk_length, index.message_start_time, index.message_end_time


def _signature(facts: ChunkFacts) -> _Signature:
    return facts.length, facts.start_ns, facts.end_ns
