"""The section on truth: quick figures of this stage, and the headline of evaluate where it has run."""

from collections.abc import Mapping
from typing import Any

from pipeline.report.analysis import Analysis, TruthScore
from pipeline.report.lengths import metres
from pipeline.report.markup import label, table, text
from pipeline.report.markup import section as card
from pipeline.report.mission import Mission

METRICS = {
    "energy_score_m": "energy score (m)",
    "ade_m": "mean error of a hypothesis (m)",
    "coverage_90": "coverage of the 90 % region",
}
"""Metrics of scores.json that are shown, and what they are called here."""


def truth_section(mission: Mission, analysis: Analysis) -> str:
    """Quick figures; the careful ones are those of evaluate, which are shown too where they are there."""
    if mission.truth is None and mission.scores is None:
        return ""
    sides = (("past, origin included", analysis.past), ("future", analysis.future))
    rows = [_score_row(name, score) for name, score in sides if score is not None]
    heads = ["steps", "compared", "mean error of the mean", "median error of the mean", "truth inside the 90 % band"]
    none = "<p>Truth covers no step of any window.</p>"
    content = table(heads, rows, numeric=(1, 2, 3, 4), kind="compact") if rows else none
    if mission.scores is not None:
        content += f"<h3>Scores of cadence evaluate</h3>{_scores(mission, mission.scores)}"
    lead = (
        "Quick figures from truth in the log: every step from an agent’s first detection in the window on counts once, and "
        "neighbouring steps are not independent. A well-calibrated 90 % band holds truth about 90 % of the time. "
        "cadence evaluate gives scores with intervals and beside rivals."
    )
    return card("Against truth", content, lead)


def _score_row(name: str, score: TruthScore) -> list[str]:
    errors = [metres(score.mean_error_m), metres(score.median_error_m)]
    return [name, f"{score.num_steps:,}", *errors, f"{100 * score.coverage:.0f} %"]


def _scores(mission: Mission, scores: Mapping[str, Any]) -> str:
    """Headline rows: estimator and part down, metrics across, each with its interval."""
    if mission.has_stale_scores:
        return "<p>scores.json belongs to other hypotheses than these; run cadence evaluate and cadence report again.</p>"
    found: dict[tuple[str, str], dict[str, str]] = {}
    for row in scores.get("rows") or []:
        if (
            isinstance(row, dict)
            and row.get("by") == "part"
            and row.get("part") in ("past", "future")
            and row.get("metric") in METRICS
        ):
            cells = found.setdefault((str(row["part"]), str(row.get("estimator"))), {})
            cells[str(row["metric"])] = f"{_number(row.get('value'))} ({_number(row.get('low'))} to {_number(row.get('high'))})"
    rows = [
        [label(part), text(estimator), *(text(cells.get(metric, "–")) for metric in METRICS)]
        for (part, estimator), cells in sorted(found.items(), key=lambda item: item[0][0] != "past")
    ]
    if not rows:
        return "<p>scores.json holds no row for past or future.</p>"
    return table(["steps", "estimator", *METRICS.values()], rows, numeric=(2, 3, 4), kind="compact")


def _number(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, int | float) else "–"
