"""Scored missions as tables: pooled rows with intervals, ratios between estimators, and their JSON, CSV and Markdown."""

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cadence.arrays import Int64s
from pipeline.counted import counted
from pipeline.evaluate.joint import JOINT_METRICS, JointCells, block_of, summarise_joint
from pipeline.evaluate.maps import MapCells, map_rows
from pipeline.evaluate.markdown import line, ordered, value, with_interval
from pipeline.evaluate.whole import WholeCells, whole_rows, whole_table, whole_verdict
from pipeline.plain_rows import rows_as_csv, without_nan
from pipeline.score_words import away_words, coverage_words, estimator_words
from pipeline.scoring.motion import MotionLaws, MotionSample, motion_rows
from pipeline.scoring.scores import PARTS, Cells, ScoreRow, energy_ratio, groups_of, summarise

OWN_NAME = "cadence"
"""The estimator whose hypotheses a mission directory holds, in every table."""

SCORES_VERSION = 1
_MIN_LOGS = 6
_PART_METRICS = {
    "energy_score_m": "energy score m", "trajectory_energy_score_m": "trajectory energy m", "ade_m": "ADE m",
    "min_ade_m": "minADE m", "mean_error_m": "error of mean m", "coverage_50": "in 50 %", "coverage_90": "in 90 %",
    "spread_m": "spread m", "step_length_m": "step m", "true_step_length_m": "true step m", "collision_share": "collisions",
    "map_score": "MapScore",
    "height_energy_score_m": "height energy m", "height_coverage_90": "height in 90 %", "energy_score_3d_m": "energy 3-D m",
    "coverage_90_3d": "in 90 % 3-D",
}  # fmt: skip
_MOTION_TITLES = {
    "speed_w1_mps": "speed m/s", "acceleration_w1_mps2": "acceleration m/s²", "turn_w1_deg": "turn a step °",
}  # fmt: skip
_JOINT_TITLES = {
    "joint_energy_score_m": "joint energy m", "joint_min_ade_m": "joint minADE m", "gospa_m": "GOSPA m",
    "localisation_error_m": "error of assigned m", "num_missed": "missed", "num_false": "false",
}  # fmt: skip
_WITH_INTERVAL = ("joint_energy_score_m", "joint_min_ade_m", "gospa_m")
_SLICE_TITLES = {
    ("between", "gap"): "Past, by length of the gap between the detections around it",
    ("past", "nearest"): "Past, by time to the nearest detection",
    ("past", "age"): "Past, by age of the last detection",
    ("future", "horizon"): "Future, by horizon",
    ("future", "age"): "Future, by age of the last detection",
}


@dataclass(frozen=True, eq=False)
class ScoredMission:
    """Cells of the stored hypotheses and of every rival on the same windows.

    cells         by estimator, OWN_NAME first; all in the same order
    num_unscored  (window, agent) pairs with truth and detections but without hypotheses: these are spared
    true_collision_share  of the steps of the truth, those that lie in an obstacle; None without obstacles
    motion, true_motion  how hypotheses move, by estimator, and how the truth does
    joint         by estimator, scores of all agents together; empty for one agent
    maps          by estimator and of the distance rings, MapScore of some cells
    is_matched    detections are of unknown origin: agents were matched to those of the truth
    whole         mission hypotheses beside the windows; None where there are none to compare
    """

    log_id: str
    step_s: float
    num_windows: int
    agent_ids: tuple[str, ...]
    num_hypotheses: int
    max_truth_gap_s: float
    num_unscored: int
    cells: dict[str, Cells]
    joint: dict[str, JointCells] = field(default_factory=dict)
    gospa_cutoff_m: float | None = None
    is_matched: bool = False
    motion: dict[str, MotionLaws] = field(default_factory=dict)
    true_motion: MotionLaws = field(default_factory=dict)
    true_collision_share: float | None = None
    maps: dict[str, MapCells] = field(default_factory=dict)
    whole: WholeCells | None = None


@dataclass(frozen=True)
class ScoredLog:
    """What was scored of one log."""

    log_id: str
    step_s: float
    num_windows: int
    num_agents: int
    num_hypotheses: int
    max_truth_gap_s: float
    num_unscored: int
    gospa_cutoff_m: float | None = None
    is_matched: bool = False
    true_collision_share: float | None = None


@dataclass(frozen=True)
class RatioRow:
    """Energy score of an estimator over that of a rival on the same cells; below 1 it is ahead."""

    estimator: str
    rival: str
    part: str
    value: float
    low: float
    high: float
    num_cells: int
    num_groups: int


@dataclass(frozen=True)
class ScoreReport:
    """Everything in scores.json. `grouped_by` says what was resampled: "log", "agent" or "block" of time."""

    version: int
    grouped_by: str
    logs: tuple[ScoredLog, ...]
    rows: tuple[ScoreRow, ...]
    ratios: tuple[RatioRow, ...]


def pool(missions: Sequence[ScoredMission], num_resamples: int, seed: int) -> ScoreReport:
    """Rows and ratios over the cells of all missions; estimators that some mission lacks are left out."""
    names = [name for name in missions[0].cells if all(name in mission.cells for mission in missions)]
    cells = {name: Cells.concatenate([mission.cells[name] for mission in missions]) for name in names}
    groups, grouped_by = _groups(missions)
    own = cells[names[0]]
    rows = [row for name in names for row in summarise(name, cells[name], groups, seed, num_resamples)]
    rows += _joint_rows(missions, names, num_resamples, seed)
    rows += _motion_rows(missions, names)
    mapped = [(mission.maps, mission.num_windows) for mission in missions if mission.maps]
    rows += map_rows(mapped, grouped_by == "log", num_resamples, seed)
    whole = [mission.whole for mission in missions if mission.whole is not None]
    rows += whole_rows(whole, OWN_NAME, grouped_by == "log", num_resamples, seed)
    ratios = []
    for rival in names[1:]:
        for part in PARTS:
            found = energy_ratio(own, cells[rival], part, groups, seed, num_resamples)
            if found.num_values:
                ratios.append(RatioRow(names[0], rival, part, *dataclasses.astuple(found)))
    logs = tuple(
        ScoredLog(
            mission.log_id, mission.step_s, mission.num_windows, len(mission.agent_ids), mission.num_hypotheses,
            mission.max_truth_gap_s, mission.num_unscored, mission.gospa_cutoff_m, mission.is_matched,
            mission.true_collision_share,
        )
        for mission in missions
    )  # fmt: skip
    return ScoreReport(SCORES_VERSION, grouped_by, logs, tuple(rows), tuple(ratios))


def _joint_rows(missions: Sequence[ScoredMission], names: Sequence[str], num_resamples: int, seed: int) -> list[ScoreRow]:
    """Rows on all agents together, over the missions of several agents; resampled are these, or blocks of time in them."""
    several = [mission for mission in missions if mission.joint]
    rows: list[ScoreRow] = []
    for name in names:
        cells = [mission.joint[name] for mission in several]
        if len(missions) >= _MIN_LOGS:
            groups = [np.full(len(part), index) for index, part in enumerate(cells)]
        else:
            groups = [
                block_of(part, mission.num_windows) + 1000 * index
                for index, (part, mission) in enumerate(zip(cells, several, strict=True))
            ]
        if several:
            rows += summarise_joint(name, JointCells.concatenate(cells), np.concatenate(groups), seed, num_resamples)
    return rows


def _motion_rows(missions: Sequence[ScoredMission], names: Sequence[str]) -> Iterator[ScoreRow]:
    """Laws of motion of all missions together; of missions whose targets are of one kind, as in one folder they should be."""
    measured = [mission for mission in missions if mission.motion]
    if not measured:
        return

    def together(of: Callable[[ScoredMission], MotionLaws]) -> MotionLaws:
        parts = [of(mission) for mission in measured]
        return {part: MotionSample.concatenate([laws[part] for laws in parts]) for part in parts[0]}

    truth = together(lambda mission: mission.true_motion)
    for name in names:
        yield from motion_rows(name, together(lambda mission, name=name: mission.motion[name]), truth)  # type: ignore[misc]


def as_json(report: ScoreReport) -> str:
    """scores.json; NaN becomes null."""
    return json.dumps(without_nan(dataclasses.asdict(report)), indent=1) + "\n"


def as_csv(report: ScoreReport) -> str:
    """scores.csv: a line per row."""
    return rows_as_csv(ScoreRow, report.rows)


def as_markdown(report: ScoreReport) -> str:
    """scores.md: what a person reads first."""
    lines = ["# Scores", "", *(f"* {line}" for line in verdict(report)), "", *_preface(report)]
    for part in PARTS:
        lines += _part_table(report, part)
    lines += whole_table(report.rows, OWN_NAME)
    lines += _motion_table(report)
    lines += _ratio_table(report)
    lines += _joint_tables(report)
    for (part, by), title in _SLICE_TITLES.items():
        lines += _slice_table(report, part, by, title)
    return "\n".join(lines).rstrip() + "\n"


def verdict(report: ScoreReport) -> list[str]:
    """What to believe: a sentence on past, future (best rival, 90 % region), mission hypotheses, obstacles that are none."""
    parts = [" ".join([f"{part.capitalize()}:", *found]) for part in ("past", "future") if (found := _verdict(report, part))]
    return [*parts, *whole_verdict(report.rows), *_entered(report.logs)]


def _entered(logs: Sequence[ScoredLog]) -> Iterator[str]:
    """A line for the log whose truth was most in obstacles, where any was: hypotheses keep out of what is none."""
    shares = [(log.true_collision_share or 0.0, log.log_id) for log in logs]
    share, log_id = max(shares, default=(0.0, ""))
    if share > 0.0:
        yield (
            f"Obstacles: {max(100 * share, 0.1):.3g} % of the true steps of {log_id} lie in one, and hypotheses keep out "
            'of them; check where they lie, or set infer.guidance.mode = "none".'
        )


def _verdict(report: ScoreReport, part: str) -> list[str]:
    best = max((ratio for ratio in report.ratios if ratio.part == part), key=lambda ratio: ratio.value, default=None)
    own = [row for row in report.rows if (row.estimator, row.part, row.by) == (OWN_NAME, part, "part")]
    held = next((row for row in own if row.metric == "coverage_90"), None)
    sentences = []
    if best is not None:
        is_certain = best.high < 1 or best.low > 1
        apart = f"{away_words(best.value)} of the best rival ({estimator_words(best.rival)})"
        sentences.append(f"the energy score is {apart}{'' if is_certain else ', which may be chance'};")
    if held is not None and math.isfinite(held.value):
        judged = coverage_words(held.value, held.low, held.high)
        sentences.append(f"the 90 % region holds {100 * held.value:.0f} % of the truth: {judged}.")
    return sentences


def headline(report: ScoreReport) -> list[dict[str, Any]]:
    """The few numbers that a stage summary shows."""
    metrics = ("energy_score_m", "ade_m", "coverage_90")
    return [
        {"estimator": row.estimator, "part": row.part, "metric": row.metric, "value": without_nan(row.value)}
        for row in report.rows
        if row.by == "part" and row.part in ("past", "future") and row.metric in metrics
    ]


def _groups(missions: Sequence[ScoredMission]) -> tuple[Int64s, str]:
    """Bootstrap group of every pooled cell: its log where there are enough logs, else its agent (and block of time)."""
    own = [next(iter(mission.cells.values())) for mission in missions]
    if len(missions) >= _MIN_LOGS:
        return np.repeat(np.arange(len(own)), [len(cells) for cells in own]), "log"
    parts, offset, is_by_agent = [], 0, True
    for mission, cells in zip(missions, own, strict=True):
        group = groups_of(cells, mission.num_windows)
        is_by_agent &= np.array_equal(group, cells.agent)
        parts.append(group + offset)
        offset += int(group.max(initial=0)) + 1
    return np.concatenate(parts), "agent" if is_by_agent else "block"


def _preface(report: ScoreReport) -> list[str]:
    whole = {"log": "logs", "agent": "agents", "block": "agents × ten blocks of time"}[report.grouped_by]
    lines = [
        f"Intervals: 95 %, bootstrap over {whole}. Energy scores in the plain form. Coverage is right at 50 and 90 %.",
        "Means are over cells: one window, agent and step with known truth each.",
        "",
    ]
    for log in report.logs[:20]:
        spared = f"; {log.num_unscored} window-agent pairs had no hypotheses and are spared" if log.num_unscored else ""
        lines.append(
            f"* {log.log_id}: {counted(log.num_windows, 'window')}, {counted(log.num_agents, 'agent')}, "
            f"{counted(log.num_hypotheses, 'hypothesis', 'hypotheses')}, "
            f"step {log.step_s:g} s, truth interpolated over at most {log.max_truth_gap_s:g} s{spared}"
        )
    if len(report.logs) > 20:
        lines.append(f"* and {counted(len(report.logs) - 20, 'more log')}")
    return [*lines, ""]


def _part_table(report: ScoreReport, part: str) -> list[str]:
    found = {(row.estimator, row.metric): row for row in report.rows if row.by == "part" and row.part == part}
    if not found:
        return []
    shown = [name for name in _PART_METRICS if any(metric == name for _, metric in found)]
    lines = [f"## {part.capitalize()}", "", line(["estimator", *(_PART_METRICS[name] for name in shown), "cells"])]
    lines.append(line(["---"] * (len(shown) + 2)))
    for estimator in ordered(row.estimator for row in found.values()):
        rows = [found.get((estimator, name)) for name in shown]
        cells = [(with_interval if name == "energy_score_m" else value)(row) for name, row in zip(shown, rows, strict=True)]
        lines.append(line([estimator, *cells, str(next((row.num_cells for row in rows if row), 0))]))
    return [*lines, ""]


def _motion_table(report: ScoreReport) -> list[str]:
    """Whether the tracks could have been driven: what single steps do not show."""
    shares = ("fast_step_share", "fast_track_share")
    found = {
        (row.estimator, row.part, row.metric): row
        for row in report.rows
        if row.by == "motion" or (row.by == "part" and row.metric in shares and row.part in ("past", "future"))
    }
    if not found:
        return []
    titles = {"fast_step_share": "steps too fast", "fast_track_share": "tracks with such a step", **_MOTION_TITLES}
    lines = [
        "## Motion",
        "",
        "Too fast: longer than all true steps but one in a thousand. Distances: Wasserstein's, to the truth's law.",
        "",
    ]
    lines += [line(["estimator", "", *titles.values()]), line(["---"] * (len(titles) + 2))]
    for estimator in ordered(name for name, _, _ in found):
        for part in ("past", "future"):
            cells = [value(found.get((estimator, part, metric))) for metric in titles]
            lines.append(line([estimator, part, *cells]))
    return [*lines, ""]


def _ratio_table(report: ScoreReport) -> list[str]:
    if not report.ratios:
        return []
    lines = [f"## Energy score of {report.ratios[0].estimator} over that of", ""]
    lines += [line(["rival", *PARTS]), line(["---"] * (len(PARTS) + 1))]
    for rival in ordered(row.rival for row in report.ratios):
        by_part = {row.part: row for row in report.ratios if row.rival == rival}
        lines.append(line([rival, *(with_interval(by_part.get(part)) for part in PARTS)]))
    return [*lines, ""]


def _joint_tables(report: ScoreReport) -> list[str]:
    """A table a part: all agents of a window as one vector, and as a set."""
    rows = [row for row in report.rows if row.by == "joint"]
    if not rows:
        return []
    lines = ["## All agents together", "", *_joint_preface(report)]
    for part in PARTS:
        found = {(row.estimator, row.metric): row for row in rows if row.part == part}
        shown = [name for name in JOINT_METRICS if any(metric == name for _, metric in found)]
        if shown:
            lines += [f"### {part.capitalize()}", "", line(["estimator", *(_JOINT_TITLES[name] for name in shown), "windows"])]
            lines.append(line(["---"] * (len(shown) + 2)))
        for estimator in ordered(name for name, _ in found):
            cells = [found.get((estimator, name)) for name in shown]
            texts = [(with_interval if name in _WITH_INTERVAL else value)(row) for name, row in zip(shown, cells, strict=True)]
            lines.append(line([estimator, *texts, str(max(row.num_cells for row in cells if row))]))
        lines += [""] if shown else []
    return lines


def _joint_preface(report: ScoreReport) -> list[str]:
    whole = "logs" if report.grouped_by == "log" else "ten blocks of time"
    lines = [
        f"Intervals: bootstrap over {whole}. Joint scores take all agents of a window as one vector. GOSPA (order 2) compares",
        "the weighted mean positions with the truth as sets; missed and false are agents a step.",
    ]
    cutoffs = sorted({f"{log.gospa_cutoff_m:.3g} m" for log in report.logs if log.gospa_cutoff_m is not None})
    lines[-1] += f" Cut-off: {', '.join(cutoffs[:5])}."
    if any(log.is_matched for log in report.logs):
        lines.append(
            "Where detections are of unknown origin, agents are matched to those of the truth, window by window, by the "
            "detections that they were given; rivals see the detections under the likeliest association."
        )
    return [*lines, ""]


def _slice_table(report: ScoreReport, part: str, by: str, title: str) -> list[str]:
    rows = [row for row in report.rows if row.part == part and row.by == by]
    if not rows:
        return []
    names = ordered(row.estimator for row in rows)
    lines = [f"## {title}", "", line(["steps", *(f"{name} energy m" for name in names), f"{names[0]} in 90 %", "cells"])]
    lines.append(line(["---"] * (len(names) + 3)))
    for bounds in ordered((row.above_steps, row.up_to_steps) for row in rows):
        found = {(row.estimator, row.metric): row for row in rows if (row.above_steps, row.up_to_steps) == bounds}
        energies = [found.get((name, "energy_score_m")) for name in names]
        label = f"{max(bounds[0] or 0.0, 0.0):g}–{bounds[1]:g}"
        count = next((row.num_cells for row in energies if row), 0)
        lines.append(line([label, *map(value, energies), value(found.get((names[0], "coverage_90"))), str(count)]))
    return [*lines, ""]
