"""All times of a mission on one clock: that of the stamps where the sources share one, else that of the log.

Sources whose stamps cannot be meant take the log's times, those on another clock are shifted to the common one, and each is
told as a suspicion.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from cadence.arrays import Bools, Int64s
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.clocks import MIN_ROWS, Clock, Judgement, Stamps, judge, strays
from pipeline.extract.positions import Positions
from pipeline.mapping.sources import LOG_TIME, PUBLISH_TIME
from pipeline.suspicions import Suspicions

_REPEATED: Final = 0.5
TRUSTED = 'extract.trusted = ["time"]'


class MissionClock:
    """The clock to which sources are brought."""

    def __init__(self, clock: Clock, suspicions: Suspicions) -> None:
        self.clock, self.suspicions = clock, suspicions

    def mended(self, subject: str, stamps: Stamps, judged: Judgement | None = None, setting: str = "") -> tuple[Int64s, Bools]:
        """The times [N] of a source on the mission's clock, and which rows [N] are to be kept."""
        if not self.suspicions.looks_for("time"):
            return stamps.time_ns, np.ones(len(stamps), np.bool_)
        judgement = judged or judge(stamps)
        clock, mission_ns = judgement.clock, self.clock.ahead_ns(stamps.log_time_ns)
        time_ns, is_good = stamps.time_ns, judgement.is_good
        seen, done = [judgement.fault] * bool(judgement.fault), list[str]()
        if clock is not None and not clock.agrees_with(self.clock):
            ahead_ns = clock.ahead_ns(stamps.log_time_ns) - mission_ns
            ahead_s = float(np.median(ahead_ns)) * 1e-9
            time_ns = time_ns - ahead_ns
            seen.append(f"its clock is {ahead_s:+.6g} s from that of the log and of other sources")
            done.append(f"its stamps are shifted by {-ahead_s:+.6g} s")
        if len(stamps) < MIN_ROWS:
            is_good = ~strays(stamps, self.clock)
            seen += ["its few stamps cannot be of the mission's clock"] * (not is_good.all())
        if not is_good.all():
            done.append(f"{int((~is_good).sum())} times are those of the log")
        if judgement.is_copy.any():
            done.append(f"the first time counts, {int(judgement.is_copy.sum())} positions of the others are left out")
        if seen:
            self.suspicions.add("time", subject, seen="; ".join(seen), done=", ".join(done), setting=f"{setting}{TRUSTED}")
        return np.where(is_good, time_ns, stamps.log_time_ns + mission_ns), ~judgement.is_copy


def on_one_clock(
    parts: Mapping[str, Sequence[tuple[ChannelReader, Positions]]], suspicions: Suspicions
) -> tuple[dict[str, list[Positions]], MissionClock]:
    """The rows of every reader by role, in the order of the log, with their times on one clock; and that clock."""
    if not suspicions.looks_for("time"):
        return {role: [rows for _, rows in found] for role, found in parts.items()}, MissionClock(Clock(), suspicions)
    judged: dict[int, tuple[Stamps, Judgement]] = {}
    clocks = []
    for found in parts.values():
        for reader, rows in found:
            if reader.source.time in (LOG_TIME, PUBLISH_TIME):
                clocks.append(Clock())
            elif len(rows):
                stamps = Stamps(rows.time_ns, rows.log_time_ns, np.column_stack([rows.first, rows.second]), rows.agent)
                judged[id(reader)] = stamps, judge(stamps)
                clocks += [clock for clock in [judged[id(reader)][1].clock] if clock is not None]
    is_shared = bool(clocks) and all(clock.agrees_with(clocks[0]) for clock in clocks)
    mission = MissionClock(clocks[0] if is_shared and not clocks[0].is_log else Clock(), suspicions)

    for found in parts.values():
        for reader, rows in found:
            clock = judged[id(reader)][1].clock if id(reader) in judged else None
            is_other = clock is not None and not clock.agrees_with(mission.clock)
            if is_other and _are_repeated(rows, [other for _, other in found if other is not rows]):
                stamps, judgement = judged[id(reader)]
                judged[id(reader)] = stamps, replace(judgement, clock=None)

    def mended(role: str, reader: ChannelReader, rows: Positions) -> Positions:
        if id(reader) not in judged:
            return rows
        setting = f'time = "log_time" in its [[extract.{role}]], or '
        time_ns, is_kept = mission.mended(reader.channel.topic, *judged[id(reader)], setting)
        return rows.changed(time_ns=time_ns)[is_kept]

    return {role: [mended(role, *pair) for pair in found] for role, found in parts.items()}, mission


def _are_repeated(rows: Positions, others: Sequence[Positions]) -> bool:
    """Whether most of what a source says another one says of the same moment: then it comes late, and its clock is right."""
    told = _said(rows)
    return any(len(told & _said(other)) > _REPEATED * len(told) for other in others if len(other))


def _said(rows: Positions) -> set[tuple[int, float, float]]:
    return set(zip(rows.time_ns.tolist(), rows.first.tolist(), rows.second.tolist(), strict=True))
