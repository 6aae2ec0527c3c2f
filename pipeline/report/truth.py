"""The section on truth: figures of `cadence evaluate`, with rivals and intervals where it has run, and the laws of motion."""

from collections.abc import Mapping
from typing import Any

from pipeline.lengths import metres
from pipeline.report.analysis import Analysis
from pipeline.report.markup import label, table, text
from pipeline.report.markup import section as card
from pipeline.report.mission import Mission
from pipeline.report.scored import PARTS, Scored
from pipeline.score_words import estimator_words

METRICS = {
    "energy_score_m": "energy score",
    "ade_m": "a hypothesis is off by",
    "mean_error_m": "their mean is off by",
    "coverage_50": "in the 50 % region",
    "coverage_90": "in the 90 % region",
}
"""Metrics of scores.json that are shown, and what they are called here."""

QUICK = tuple(metric for metric in METRICS if metric != "energy_score_m")
"""What needs no run of evaluate."""

MOTION = {
    "fast_step_share": "steps too fast", "fast_track_share": "tracks with such a step", "speed_w1_mps": "speed off by (m/s)",
    "acceleration_w1_mps2": "acceleration off by (m/s²)", "turn_w1_deg": "turn a step off by (°)",
}  # fmt: skip
"""The same of how tracks move."""

WORDS = (
    "Every step from an agent’s first detection in a window on counts once; neighbouring steps are not independent. Half of "
    "the truth should lie in the 50 % region, and 90 % in the 90 % region. The energy score, where it stands, is the distance "
    "of all hypotheses together from the truth: less where they are nearer and say more honestly how unsure they are."
)
MOTION_WORDS = (
    "Whether tracks move as the targets do. Too fast: faster than all true steps but one in a thousand. Off by: how far "
    "speeds, accelerations and turns must be shifted, on average, to be distributed as the true ones (Wasserstein’s distance)."
)


def truth_section(mission: Mission, analysis: Analysis) -> str:
    """The table of evaluate where it has run on these hypotheses, else the same figures without intervals and rivals."""
    scored = analysis.scored
    if not scored and mission.scores is None:
        return ""
    content = ""
    if mission.scores is not None and mission.has_stale_scores:
        content += "<p>scores.json belongs to other hypotheses than these; run cadence evaluate and cadence report again.</p>"
    if mission.scores is not None and not mission.has_stale_scores:
        content += _evaluated(mission.scores)
    elif isinstance(scored, Scored):
        heads = ["", "steps compared", *(METRICS[metric] for metric in QUICK)]
        content += table(heads, _rows(scored), numeric=range(1, len(heads)), kind="compact")
        content += '<p class="note">cadence evaluate adds energy scores, intervals, and rivals to compare with.</p>'
    elif scored:
        content += f"<p>{text(scored)}</p>"
    if isinstance(scored, Scored):
        content += f"<h3>Motion</h3><p>{text(MOTION_WORDS)}</p>"
        content += table(["", *MOTION.values()], _motion_rows(scored), numeric=range(1, 6), kind="compact")
    return card("Against the truth", content, WORDS + _who(scored))


def _who(scored: Scored | str) -> str:
    if isinstance(scored, str) or not scored.is_matched:
        return ""
    return (
        " The log does not say who was seen: in each window, agents stand for those of the truth whose positions their "
        "detections fit best."
    )


def _rows(scored: Scored) -> list[list[str]]:
    return [
        [part, f"{len(scored.errors_m(part)):,}", *(_value(metric, scored.mean(part, metric)) for metric in QUICK)]
        for part in PARTS
        if len(scored.errors_m(part))
    ]


def _motion_rows(scored: Scored) -> list[list[str]]:
    rows = []
    for part in PARTS:
        values = {name: scored.mean(part, name) for name in MOTION if name.endswith("_share")}
        values |= {name: scored.distance(part, name) for name in MOTION if name not in values}
        rows.append([part, *(_value(name, value) for name, value in values.items())])
    return rows


def _evaluated(scores: Mapping[str, Any]) -> str:
    """Rows of scores.json: estimator and part down, metrics across, each with its interval."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    for row in scores.get("rows") or []:
        if isinstance(row, dict) and row.get("by") == "part" and row.get("part") in PARTS and row.get("metric") in METRICS:
            cells = found.setdefault((str(row["part"]), str(row.get("estimator"))), {})
            value, low, high = (_value(row["metric"], row.get(part)) for part in ("value", "low", "high"))
            # A unit that all three share is told once.
            cells[str(row["metric"])] = f"{value} ({low.removesuffix(' %')} to {high.removesuffix(' %')})"
    rows = [
        [label(part), text(estimator_words(estimator)), *(text(cells.get(metric, "–")) for metric in METRICS)]
        for (part, estimator), cells in sorted(found.items(), key=lambda item: PARTS.index(item[0][0]))
    ]
    if not rows:
        return "<p>scores.json holds no row for past or future.</p>"
    return table(["", "estimator", *METRICS.values()], rows, numeric=range(2, 7), kind="compact")


def _value(metric: str, value: object) -> str:
    if not isinstance(value, int | float) or value != value:
        return "–"
    if metric.startswith("coverage"):
        return f"{100 * value:.0f} %"
    if metric.endswith("_share"):
        return f"{100 * value:.3g} %"
    return metres(value) if metric.endswith("_m") else f"{value:.3g}"
