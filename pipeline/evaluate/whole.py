"""Mission hypotheses, which know all detections, beside the windows' hypotheses, which know those up to a moment: past alone.

Every step of an agent counts once. The windows' answer to it is that of the window in which it lies nearest to the middle of
the past: that one sees the most to both sides of it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cadence import metrics
from cadence.arrays import Bools, Float64s, Int64s
from cadence.types import HypothesisSet
from pipeline.evaluate.markdown import line, value, with_interval
from pipeline.score_words import away_words, coverage_words, estimator_words
from pipeline.scoring.case import Case
from pipeline.scoring.scores import Cells, Draw, ScoreRow, groups_of
from pipeline.stories import MissionStories

WHOLE_NAME = "mission"
BY_MISSION = "mission"
"""What tells these rows of scores.json from those of all windows."""

_TITLES = {
    "energy_score_m": "energy score m", "ade_m": "ADE m", "mean_error_m": "error of mean m", "coverage_50": "in 50 %",
    "coverage_90": "in 90 %", "spread_m": "spread m", "fast_step_share": "steps too fast",
}  # fmt: skip
_RATIO = "energy_score_ratio"


@dataclass(frozen=True, eq=False)
class WholeCells:
    """Cells of the windows' hypotheses and of the mission hypotheses: the same steps in the same order, each once.

    num_windows  of the mission
    """

    windows: Cells
    mission: Cells
    num_windows: int

    def __post_init__(self) -> None:
        for name in ("window", "agent", "step"):
            if not np.array_equal(getattr(self.windows, name), getattr(self.mission, name)):
                raise ValueError(f"WholeCells: the two differ in {name}; both must be of the same steps")


def score_whole(
    case: Case, found: MissionStories, own: Cells, score: Callable[[Draw, Tensor, int], Cells]
) -> WholeCells | None:
    """Mission hypotheses on steps that the cells `own` of the windows tell of; None without any.

    Where the log does not say who was seen there are none: agents of a mission hypothesis are no agents of a window.

    Args:
        case: of the windows.
        found: the mission hypotheses.
        own: cells of all windows.
        score: gives the cells of a draw on the known steps [B, A, T], for so many hypotheses.
    """
    if case.is_matched:
        return None
    chosen = told_once(case, found, own)
    if not chosen.any():
        return None
    windows = _selected(own, chosen)
    is_known = torch.zeros_like(case.is_known)
    is_known[windows.window, windows.agent, windows.step + case.scored.origin_index] = True
    mission = score(MissionDraws(case, found).draw, is_known, found.stories.num_hypotheses)
    return WholeCells(windows, mission, case.windows.batch.num_windows)


@dataclass(frozen=True, eq=False)
class MissionDraws:
    """Mission hypotheses at the steps of windows."""

    case: Case
    found: MissionStories

    def draw(self, index: Tensor) -> HypothesisSet:
        """Those of the windows with the indices [b]; beyond its ends a track stands still, and no such step is asked for."""
        windows, stories = self.case.windows, self.found.stories
        k, num_agents, num_steps = stories.num_hypotheses, len(windows.agent_ids), windows.batch.num_steps
        position = np.full((len(index), k, num_agents, num_steps, 2), np.nan)
        span_s = _spans_s(self.found)
        for row, b in enumerate(index.tolist()):
            time_s = (_time_ns(self.case, b) - self.found.start_ns) * 1e-9
            for number, name in enumerate(stories.agent_ids):
                if name in windows.agent_ids:
                    at = stories.of([number]).at(np.clip(time_s, *span_s[number]))[:, 0] - windows.datum_m[b]
                    position[row, :, windows.agent_ids.index(name)] = at
        weight = torch.from_numpy(np.broadcast_to(stories.weight, (len(index), k)).copy())
        status = tuple(tuple("ok" for _ in windows.agent_ids) for _ in range(len(index)))
        return HypothesisSet(torch.from_numpy(position), weight, status)


def _spans_s(found: MissionStories) -> Float64s:
    """When each agent's tracks begin and end [A, 2]; the same in all stories where the log says who was seen."""
    is_there: Bools = np.logical_and.reduce(found.stories.is_present, axis=0)
    time_s = found.stories.time_s
    spans = [(time_s[there][0], time_s[there][-1]) if there.any() else (time_s[0], time_s[0]) for there in is_there]
    return np.array(spans, dtype=np.float64).reshape(-1, 2)


def _time_ns(case: Case, window: int) -> Int64s:
    steps = np.arange(case.scored.num_steps, dtype=np.int64) - case.scored.origin_index
    return np.asarray(case.windows.origins_ns[window] + steps * case.windows.step_ns)


def told_once(case: Case, found: MissionStories, own: Cells) -> Bools:
    """Which cells count [C]: those of the past where mission hypotheses tell of the agent, each step in its best window."""
    time_ns = case.windows.origins_ns[own.window] + own.step.astype(np.int64) * case.windows.step_ns
    span_ns = np.full((len(case.windows.agent_ids), 2), np.iinfo(np.int64).min)
    for name, span_s in zip(found.stories.agent_ids, _spans_s(found), strict=True):
        if name in case.windows.agent_ids:
            span_ns[case.windows.agent_ids.index(name)] = found.start_ns + np.round(span_s * 1e9).astype(np.int64)
    is_told = (time_ns >= span_ns[own.agent, 0]) & (time_ns <= span_ns[own.agent, 1]) & own.is_in("past")
    off_middle = np.abs(own.step + case.scored.origin_index / 2)
    order = np.lexsort([own.window, off_middle, time_ns, own.agent])
    order = order[is_told[order]]
    is_first = np.ones(len(order), dtype=bool)
    is_first[1:] = (np.diff(own.agent[order]) != 0) | (np.diff(time_ns[order]) != 0)
    chosen = np.zeros(len(own), dtype=bool)
    chosen[order[is_first]] = True
    return chosen


def _selected(cells: Cells, chosen: Bools) -> Cells:
    names = ("window", "agent", "step", "age", "gap", "nearest", "value")
    return Cells(*(getattr(cells, name)[chosen] for name in names))


def whole_rows(
    missions: Sequence[WholeCells], own_name: str, is_by_log: bool, num_resamples: int, seed: int
) -> Iterator[ScoreRow]:
    """Rows of both estimators over the missions, and the ratio of their energy scores; `is_by_log`: logs are resampled."""
    if not missions:
        return
    rng = np.random.default_rng(seed)
    inside = [0 if is_by_log else 1 + groups_of(found.windows, found.num_windows) for found in missions]
    groups = np.concatenate(
        [np.broadcast_to(1_000_000 * number + of, len(missions[number].windows)) for number, of in enumerate(inside)]
    )
    cells = {own_name: Cells.concatenate([found.windows for found in missions])}
    cells[WHOLE_NAME] = Cells.concatenate([found.mission for found in missions])
    values = {name: {metric: part.column(metric) for metric in _TITLES} for name, part in cells.items()}
    # A step whose neighbour is another window's has no length for either.
    is_both = ~np.isnan(values[own_name]["fast_step_share"] + values[WHOLE_NAME]["fast_step_share"])
    for name, columns in values.items():
        columns["fast_step_share"] = np.where(is_both, columns["fast_step_share"], np.nan)
        for metric, column in columns.items():
            yield from _row(name, metric, metrics.bootstrap_mean(column, groups, rng, num_resamples))
    mission, windows = (values[name]["energy_score_m"] for name in (WHOLE_NAME, own_name))
    yield from _row(WHOLE_NAME, _RATIO, metrics.bootstrap_ratio(mission, windows, groups, rng, num_resamples))


def _row(name: str, metric: str, found: metrics.Interval) -> Iterator[ScoreRow]:
    if found.num_values:
        yield ScoreRow(
            name, "past", BY_MISSION, None, None, metric, found.value, found.low, found.high, found.num_values, found.num_groups
        )


def whole_table(rows: Sequence[ScoreRow], own_name: str) -> list[str]:
    """The lines of scores.md; none without such rows."""
    found = {(row.estimator, row.metric): row for row in rows if row.by == BY_MISSION}
    if not found:
        return []
    lines = [
        "## Past, told by mission hypotheses (all detections)",
        "",
        "Every step once, from an agent's first detection to its last; the windows' answer is that of the window that sees the "
        "most around it.",
        "",
        line(["", *_TITLES.values(), "cells"]),
        line(["---"] * (len(_TITLES) + 2)),
    ]
    named = {own_name: "windows (detections up to each moment)", WHOLE_NAME: estimator_words(WHOLE_NAME)}
    for name, words in named.items():
        rows_of = {metric: found.get((name, metric)) for metric in _TITLES}
        cells = [(with_interval if metric == "energy_score_m" else value)(row) for metric, row in rows_of.items()]
        lines.append(line([words, *cells, str(found[name, "ade_m"].num_cells)]))
    ratio = found.get((WHOLE_NAME, _RATIO))
    return [*lines, "", f"Energy score over that of the windows: {with_interval(ratio)}.", ""]


def whole_verdict(rows: Sequence[ScoreRow]) -> Iterator[str]:
    """A sentence on what mission hypotheses are worth; none without such rows."""
    found = {row.metric: row for row in rows if (row.estimator, row.by) == (WHOLE_NAME, BY_MISSION)}
    ratio, held = found.get(_RATIO), found.get("coverage_90")
    if ratio is None or held is None:
        return
    chance = "" if ratio.high < 1 or ratio.low > 1 else ", which may be chance"
    words, judged = estimator_words(WHOLE_NAME), coverage_words(held.value, held.low, held.high)
    yield (
        f"{words[:1].upper()}{words[1:]}: on the steps between first and last detection the energy score is "
        f"{away_words(ratio.value)} of the windows{chance}; the 90 % region holds {100 * held.value:.0f} % of the truth: "
        f"{judged}."
    )
