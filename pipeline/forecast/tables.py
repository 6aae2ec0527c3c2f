"""Scored forecasts as tables: rows with intervals, paired comparisons, and their JSON, CSV and Markdown."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cadence.arrays import Float64s
from cadence.metrics import Interval, bootstrap_ratio
from pipeline.forecast.scores import HORIZONS, MEASURES, EpisodeScores, step_quantiles
from pipeline.plain_rows import rows_as_csv, without_nan

FORECAST_VERSION = 1
STEP_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
"""Shares at which the distribution of step lengths is shown."""

TITLES = {
    "displacement_error": "Displacement error at the step (the paper's cells)",
    "paper_error": "The paper's measure (mixtures: sum of weight times distance of the means)",
    "ade": "ADE up to the step",
    "min_ade_at": "minADE: error at the step of the hypothesis that is best over the window",
    "min_ade": "minADE up to the step",
    "mean_error": "Error of the mean of the hypotheses",
    "energy_score": "Energy score",
    "coverage_50": "Share of the 50 % regions that hold the truth",
    "coverage_90": "Share of the 90 % regions that hold the truth",
}
"""Headings by measure."""

_SHARE_TITLES = {"states_in_obstacles": "states in obstacles", "segments_in_obstacles": "segments in obstacles"}


@dataclass(frozen=True)
class ForecastFacts:
    """What was evaluated, and how.

    scale_m     what distances over the map side are divided by; None: metres only
    known_goal  told to estimators that read it, and stated by some log
    """

    num_episodes: int
    num_left_out: int
    left_out: tuple[str, ...]
    num_windows: int
    num_hypotheses: int
    detection_rate: float
    step_s: float
    scale_m: float | None
    known_start: bool
    known_goal: bool
    seed: int


@dataclass(frozen=True)
class ForecastRow:
    """One number with its interval.

    `step` is the horizon's, or None for what is taken over all steps. `value` is in metres (shares: a share), `value_of_side`
    over the map side.
    """

    estimator: str
    measure: str
    step: int | None
    value: float
    low: float
    high: float
    value_of_side: float | None
    low_of_side: float | None
    high_of_side: float | None
    num_windows: int
    num_episodes: int


@dataclass(frozen=True)
class Comparison:
    """Energy score of an estimator against a rival's on the same windows; `step` None: mean over the horizons.

    difference_m  own minus rival's, metres: below 0 it is ahead
    ratio         own over rival's: below 1 it is ahead
    """

    estimator: str
    rival: str
    step: int | None
    difference_m: float
    difference_low_m: float
    difference_high_m: float
    ratio: float
    ratio_low: float
    ratio_high: float


@dataclass(frozen=True)
class ForecastReport:
    """Everything in forecast.json."""

    version: int
    facts: ForecastFacts
    rows: tuple[ForecastRow, ...]
    comparisons: tuple[Comparison, ...]
    hypotheses_per_cpu_second: dict[str, float]


def pool(scores: Mapping[str, EpisodeScores], truth: EpisodeScores, facts: ForecastFacts, num_resamples: int) -> ForecastReport:
    """Rows of every estimator, of the truth's own steps, and comparisons of the first estimator with the others."""
    rows = []
    for name, found in scores.items():
        rows += measure_rows(name, found, facts, num_resamples)
        rows += motion_rows(name, found, facts, num_resamples)
    rows += motion_rows("truth", truth, facts, num_resamples)
    names = list(scores)
    compared = [
        comparison(names[0], rival, step, scores, facts.seed, num_resamples)
        for rival in names[1:]
        for step in (*HORIZONS, None)
    ]
    drawn = facts.num_windows * facts.num_hypotheses
    speed = {name: drawn / found.seconds for name, found in scores.items() if found.seconds > 0}
    return ForecastReport(FORECAST_VERSION, facts, tuple(rows), tuple(compared), speed)


def measure_rows(name: str, scores: EpisodeScores, facts: ForecastFacts, num_resamples: int) -> list[ForecastRow]:
    """All measures at all horizons."""
    rows = []
    for measure in MEASURES:
        sums = scores.measure(measure)
        for index, step in enumerate(HORIZONS):
            found = mean_interval(sums[:, index], scores, facts.seed, num_resamples)
            rows.append(_row(name, measure, step, found, scores, None if measure.startswith("coverage") else facts.scale_m))
    return rows


def motion_rows(name: str, scores: EpisodeScores, facts: ForecastFacts, num_resamples: int) -> list[ForecastRow]:
    """Lengths of steps, and what lies in obstacles."""
    rows = [
        _row(name, share, None, mean_interval(scores.share(share), scores, facts.seed, num_resamples), scores, None)
        for share in _SHARE_TITLES
    ]
    mean = mean_interval(scores.share("step_length"), scores, facts.seed, num_resamples)
    rows.append(_row(name, "step_length_mean", None, mean, scores, facts.scale_m))
    values = step_quantiles(scores.steps.sum(axis=0), STEP_LEVELS)
    bounds = _quantile_bounds(scores, facts.seed, num_resamples)
    for level, value, (low, high) in zip(STEP_LEVELS, values, bounds.T, strict=True):
        found = Interval(float(value), float(low), float(high), int(scores.count.sum()), len(scores.episode))
        rows.append(_row(name, f"step_length_{round(100 * level)}", None, found, scores, facts.scale_m))
    return rows


def mean_interval(sums: Float64s, scores: EpisodeScores, seed: int, num_resamples: int) -> Interval:
    """Mean over windows from the sums [E] of the episodes, which are resampled."""
    rng = np.random.default_rng([seed, 21])
    return bootstrap_ratio(sums, scores.count.astype(np.float64), np.arange(len(scores.episode)), rng, num_resamples)


def comparison(
    own: str, rival: str, step: int | None, scores: Mapping[str, EpisodeScores], seed: int, num_resamples: int,
    measure: str = "energy_score", rival_measure: str | None = None,
) -> Comparison:  # fmt: skip
    """Of a measure, the energy score unless said otherwise, with the same or another one of the rival; resampled together."""
    mine, theirs = scores[own], scores[rival]
    if not np.array_equal(mine.episode, theirs.episode) or not np.array_equal(mine.count, theirs.count):
        raise ValueError(f"{own} and {rival} were not scored on the same windows")
    index = list(range(len(HORIZONS))) if step is None else [HORIZONS.index(step)]
    top = mine.measure(measure)[:, index].mean(axis=1)
    bottom = theirs.measure(rival_measure or measure)[:, index].mean(axis=1)
    difference = mean_interval(top - bottom, mine, seed, num_resamples)
    rng = np.random.default_rng([seed, 21])
    ratio = bootstrap_ratio(top, bottom, np.arange(len(top)), rng, num_resamples)
    return Comparison(own, rival, step, difference.value, difference.low, difference.high, ratio.value, ratio.low, ratio.high)


def as_json(report: ForecastReport) -> str:
    """forecast.json; NaN becomes null."""
    return json.dumps(without_nan(dataclasses.asdict(report)), indent=1) + "\n"


def as_csv(report: ForecastReport) -> str:
    """forecast.csv: a line per row."""
    return rows_as_csv(ForecastRow, report.rows)


def as_markdown(report: ForecastReport) -> str:
    """forecast.md: what a person reads first."""
    lines = ["# Forecasts", "", *_preface(report.facts)]
    lines += _comparison_table(report)
    lines += _motion_table(report)
    units = [("over the map side", True)] if report.facts.scale_m is not None else []
    for unit, is_of_side in [*units, ("metres", False)]:
        for measure, title in TITLES.items():
            if not measure.startswith("coverage") or not is_of_side:
                lines += _measure_table(report, measure, f"{title}, {unit}".removesuffix(", metres"), is_of_side)
    return "\n".join(lines).rstrip() + "\n"


def headline(report: ForecastReport) -> list[dict[str, Any]]:
    """The few numbers that a stage summary shows."""
    shown = ("displacement_error", "energy_score")
    return [
        {
            "estimator": row.estimator,
            "part": f"{_minutes(row.step, report.facts)} min",
            "metric": row.measure,
            "value": without_nan(row.value if row.value_of_side is None else row.value_of_side),
        }
        for row in report.rows
        if row.measure in shown and row.step in (0, HORIZONS[2], HORIZONS[4])
    ]


def line(cells: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits, never a power of ten above one; a dash for what is not there."""
    if value is None or math.isnan(value):
        return "–"
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if abs(value) >= 1000 and math.isfinite(value) else text


def with_interval(value: float | None, low: float | None, high: float | None, digits: int = 3) -> str:
    """`value [low, high]`; the value alone where there is no interval."""
    if low is None or high is None or math.isnan(low):
        return number(value, digits)
    return f"{number(value, digits)} [{number(low, digits)}, {number(high, digits)}]"


def _row(
    name: str, measure: str, step: int | None, found: Interval, scores: EpisodeScores, scale_m: float | None
) -> ForecastRow:
    def of_side(value: float) -> float | None:
        return None if scale_m is None else value / scale_m

    return ForecastRow(
        name, measure, step, found.value, found.low, found.high, of_side(found.value), of_side(found.low), of_side(found.high),
        int(scores.count.sum()), len(scores.episode),
    )  # fmt: skip


def _quantile_bounds(scores: EpisodeScores, seed: int, num_resamples: int) -> Float64s:
    """95 % interval [2, levels] of the quantiles of step lengths; NaN with one episode."""
    num = len(scores.episode)
    if num < 2:
        return np.full((2, len(STEP_LEVELS)), np.nan)
    drawn = np.random.default_rng([seed, 21]).integers(num, size=(num_resamples, num))
    rows = np.arange(num_resamples)[:, None] * num
    times = np.bincount((drawn + rows).ravel(), minlength=num_resamples * num).reshape(num_resamples, num)
    # How often each episode is drawn, times its masses: quantiles of every resample at once.
    found = [step_quantiles(part.astype(np.float64) @ scores.steps, STEP_LEVELS) for part in np.array_split(times, 20)]
    bounds: Float64s = np.percentile(np.concatenate(found), [2.5, 97.5], axis=0)
    return bounds


def _minutes(step: int | None, facts: ForecastFacts) -> str:
    """The paper rounds: step 29 is its column 30 min."""
    return "all" if step is None else f"{(step + (step > 0)) * facts.step_s / 60:g}"


def _preface(facts: ForecastFacts) -> list[str]:
    start = "the true start counts as a detection (as in the paper)" if facts.known_start else "the start is not known"
    goal = "told to estimators that read it" if facts.known_goal else "not told"
    side = "metres only: nothing states the map's side" if facts.scale_m is None else f"map side {facts.scale_m:g} m"
    asked = f"{facts.num_windows} random moments of {facts.num_episodes} episodes, {facts.num_hypotheses} hypotheses each"
    known = f"a step is {facts.step_s:g} s; detections at {100 * facts.detection_rate:.1f} % of the steps (mean over episodes)"
    lines = [
        f"{asked}; {known}; {start}; known goals are {goal}; {side}. After its end a target stays where it was.",
        "Intervals: 95 %, bootstrap over episodes.",
        "",
        *(f"* left out: {reason}" for reason in facts.left_out[:20]),
    ]
    if facts.num_left_out > 20:
        lines.append(f"* and {facts.num_left_out - 20} more logs are left out")
    return [*lines, *([""] if facts.left_out else [])]


def _estimators(report: ForecastReport) -> list[str]:
    return list(dict.fromkeys(row.estimator for row in report.rows))


def _measure_table(report: ForecastReport, measure: str, title: str, is_of_side: bool) -> list[str]:
    rows = {(row.estimator, row.step): row for row in report.rows if row.measure == measure}
    heads = [f"{_minutes(step, report.facts)} min" for step in HORIZONS]
    lines = [f"## {title}", "", line(["", *heads]), line(["---"] * (len(heads) + 1))]
    for name in _estimators(report):
        if (name, HORIZONS[0]) in rows:
            found = [rows[name, step] for step in HORIZONS]
            cells = [
                with_interval(row.value_of_side, row.low_of_side, row.high_of_side)
                if is_of_side
                else with_interval(row.value, row.low, row.high)
                for row in found
            ]
            lines.append(line([name, *cells]))
    return [*lines, ""]


def _comparison_table(report: ForecastReport) -> list[str]:
    if not report.comparisons:
        return []
    heads = [f"{_minutes(step, report.facts)} min" for step in HORIZONS]
    title = f"## Energy score of {report.comparisons[0].estimator} over that of"
    lines = [title, "", line(["", *heads, "all"]), line(["---"] * (len(heads) + 2))]
    for rival in dict.fromkeys(item.rival for item in report.comparisons):
        found = {item.step: item for item in report.comparisons if item.rival == rival}
        cells = [
            with_interval(item.ratio, item.ratio_low, item.ratio_high) for item in map(found.get, (*HORIZONS, None)) if item
        ]
        lines.append(line([rival, *cells]))
    return [*lines, ""]


def _motion_table(report: ForecastReport) -> list[str]:
    quantiles = [f"step_length_{round(100 * level)}" for level in STEP_LEVELS]
    heads = ["step m, mean", *(f"{round(100 * level)} %" for level in STEP_LEVELS), *_SHARE_TITLES.values(), "hypotheses/CPU s"]
    lines = ["## Lengths of steps, obstacles, speed", "", line(["", *heads]), line(["---"] * (len(heads) + 1))]
    for name in _estimators(report):
        found = {row.measure: row for row in report.rows if row.estimator == name and row.step is None}
        cells = [number(found[key].value) for key in ("step_length_mean", *quantiles)]
        cells += [f"{100 * found[key].value:.3g} %" for key in _SHARE_TITLES]
        lines.append(line([name, *cells, number(report.hypotheses_per_cpu_second.get(name))]))
    return [*lines, ""]
