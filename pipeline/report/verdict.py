"""What an analyst would say first: how far off, how well calibrated, whether the tracks could be driven, what to doubt."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from pipeline.clock import duration
from pipeline.counted import counted
from pipeline.lengths import metres, speed
from pipeline.report.analysis import Analysis, Speeds
from pipeline.report.markup import section, text
from pipeline.report.mission import Mission
from pipeline.report.scored import PARTS, Scored
from pipeline.score_words import coverage_words

_STATUS_WORDS = {"measured": "no position is known, so that the tracks rest on bearings or ranges alone"}
_FEW = 24
"""Detections below which neither models nor their tests have much to go by."""
_SURE = 0.9
"""An agent that is less likely than this may be none."""

_NARROW, _MANY_FAST, _CLEARLY = 0.83, 0.05, 1.1
"""Worth a doubt: a 90 % region that holds less; more tracks with a step faster than nearly all true ones, and clearly so."""


def verdict_section(mission: Mission, analysis: Analysis, num_parted: tuple[int, int]) -> str:
    """The first lines of the page; `num_parted` of how many pictures of the map show several ways."""
    said = [*_accuracy(mission, analysis), *_motion(analysis.speeds, analysis.scored)]
    doubts = list(_doubts(mission, analysis, num_parted))
    good = "".join(f"<li>{text(line)}</li>" for line in said)
    bad = "".join(f"<li>{text(line)}</li>" for line in doubts) or "<li>Nothing that this page knows of.</li>"
    content = f'<div class="columns"><div><h3>How good it is</h3><ul>{good}</ul></div>'
    return section("In short", f"{content}<div><h3>What to doubt</h3><ul>{bad}</ul></div></div>", kind="verdict")


def _accuracy(mission: Mission, analysis: Analysis) -> Iterator[str]:
    if not mission.fans:
        yield "No hypotheses could be drawn; the reasons stand under “Windows that need attention”."
        return
    fan = mission.fans[0]
    ahead = duration((fan.offset_m.shape[1] - 1 - fan.origin_index) * fan.step_ns / 1e9)
    spans = {"past": "Past and present", "future": f"Future, up to {ahead} ahead"}
    if isinstance(analysis.scored, Scored):
        for part in PARTS:
            yield from _against_truth(analysis.scored, part, spans[part])
        return
    reason = (
        f"it cannot be compared with the truth ({analysis.scored.rstrip('.')})" if analysis.scored else "the log holds no truth"
    )
    yield f"How far off it is, nobody can say: {reason}."
    now, end = (metres(float(np.median(spread_m))) for spread_m in (analysis.spread_now_m, analysis.spread_end_m))
    yield f"By its own account, a hypothesis is typically {now} from the middle of all at the moment, {end} {ahead} later."


def _against_truth(scored: Scored, part: str, span: str) -> Iterator[str]:
    errors_m = scored.errors_m(part)
    if not len(errors_m):
        return
    held = scored.mean(part, "coverage_90")
    yield (
        f"{span}: on average a hypothesis is {metres(scored.mean(part, 'ade_m'))} from the truth, half of the time less "
        f"than {metres(float(np.median(errors_m)))}. The region that is to hold 90 % holds {100 * held:.0f} %: "
        f"{coverage_words(held)}."
    )


def _motion(speeds: Speeds, scored: Scored | str) -> Iterator[str]:
    if not speeds.num_tracks:
        return
    fastest = f"the fastest step of any track is {speed(speeds.fastest_mps)}"
    if isinstance(scored, Scored) and np.isfinite(scored.fastest_mps):
        fastest += f", of the truth {speed(scored.fastest_mps)} (but for one in a thousand)"
    if speeds.limit_mps is None:
        yield f"Speed: {fastest}; no limit is known."
        return
    whose = "that was stated" if speeds.is_stated else "that the detections make plausible"
    count = f"{speeds.num_over:,} of {speeds.num_tracks:,} tracks"
    yield f"Speed: {count} break the limit of {speed(speeds.limit_mps)} {whose}; {fastest}."


def _doubts(mission: Mission, analysis: Analysis, num_parted: tuple[int, int]) -> Iterator[str]:
    for record in mission.suspicions:
        kind, subject, seen, done = (str(record.get(name, "")) for name in ("kind", "subject", "seen", "done"))
        yield f"{kind[:1].upper()}{kind[1:]} of {subject}: {seen}; {done}."
    if not mission.catalogue.health.is_complete:
        yield "The log is damaged: messages are lost, or may be."
    yield from _doubts_of_detections(mission)
    for status, count in Counter(row.status for row in mission.rows if row.status != "ok").most_common():
        words = _STATUS_WORDS.get(status, status.replace("_", " "))
        yield f"{count:,} of {len(mission.rows):,} pairs of a window and an agent: {words}."
    yield from _doubts_of_truth(analysis.scored, analysis.speeds)
    yield from _doubts_of_identity(mission)
    parted, shown = num_parted
    if parted:
        yield (
            f"In {parted:,} of {shown:,} pairs of a window and an agent on the map, hypotheses part into several ways: think "
            "of each, with its share, not of their mean."
        )
    speeds = analysis.speeds
    if speeds.num_over:
        yield f"{speeds.num_over:,} of {speeds.num_tracks:,} tracks are faster than the limit."


def _doubts_of_detections(mission: Mission) -> Iterator[str]:
    """Where they are few, and where nothing says how exact they are."""
    num = len(mission.detections)
    if 0 < num < _FEW:
        yield (
            f"There {'is' if num == 1 else 'are'} {counted(num, 'detection')} only: too few to learn how targets move here, or "
            "to test it on some that are held back."
        )
    records = (mission.manifests.get("extract", {}).get("summary") or {}).get("accuracy") or []
    exact = [name for record in records if not record.get("is_taken") for name in record.get("sources", ())]
    if exact:
        rest = f" and {len(exact) - 3} more" if len(exact) > 3 else ""
        yield (
            f"Detections of {', '.join(exact[:3])}{rest} count as exact, as nothing states or tells how exact they are "
            "(extract.default_sigma_m)."
        )


def _doubts_of_truth(scored: Scored | str, speeds: Speeds) -> Iterator[str]:
    if isinstance(scored, str):
        return
    for part, words in (("past", "before"), ("future", "after")):
        held = scored.mean(part, "coverage_90")
        if held <= _NARROW:  # NaN compares as false
            outside = f"{100 * (1 - held):.0f} % of the truth lies outside the 90 % region"
            yield f"Bands {words} the moment are too narrow: {outside}."
        fast = scored.mean(part, "fast_track_share")
        if fast > _MANY_FAST and speeds.fastest_mps > _CLEARLY * scored.fastest_mps:
            share = f"{100 * fast:.0f} % of the tracks {words} the moment"
            yield f"{share} hold a step faster than nearly every true one ({speed(scored.fastest_mps)})."
    if scored.every > 1:
        yield f"Only one window in {scored.every} was compared with the truth, to save time; cadence evaluate compares all."


def _doubts_of_identity(mission: Mission) -> Iterator[str]:
    best: dict[int, float] = {}
    for row in mission.rows:
        if row.probability is not None:
            best[row.agent] = max(best.get(row.agent, 0.0), row.probability)
    if not best:
        return
    doubtful = sum(probability < _SURE for probability in best.values())
    yield (
        "The log does not say who was seen: agents were found by their motion"
        + (f", and {doubtful:,} of {len(best):,} may be none (less than 90 % likely at their best)." if doubtful else ".")
    )
