"""The page of `table1.py`: leads over the rivals, cells won and lost, the tables of every set, what the trainings cost."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.forecast.leads import count, relative_lead, verdicts
from pipeline.forecast.scores import HORIZONS, MEASURES, SHARES, EpisodeScores
from pipeline.forecast.stage import ForecastConfig
from pipeline.forecast.tables import TITLES, line, mean_interval, number, with_interval

MIXTURES = ("vrnn", "grammi_without_mi", "grammi")
MINUTES = ("0", "30", "60", "90", "120 min")
LATE = HORIZONS[2:]
NAMES = {
    "vrnn": "VRNN", "grammi_without_mi": "GrAMMI without MI", "grammi": "GrAMMI", "cv": "constant velocity (Kalman)",
    "particle": "particle filter", "library": "library", "library_all": "library, all episodes", "paper": "the paper's preset",
    "cadence": "CADENCE", "truth": "truth",
}  # fmt: skip
PRINTED = {
    "prison low": [[.106, .060, .060, .057], [.093, .083, .080, .077], [.119, .109, .110, .100], [.146, .144, .154, .127],
                   [.177, .165, .163, .154]],
    "prison med": [[.172, .047, .049, .046], [.086, .078, .077, .076], [.110, .110, .110, .103], [.144, .142, .146, .129],
                   [.167, .168, .167, .153]],
    "prison high": [[.105, .016, .015, .017], [.059, .057, .056, .054], [.100, .095, .092, .078], [.117, .132, .122, .099],
                    [.145, .167, .162, .118]],
    "narco low": [[.147, .122, .121, .112], [.156, .142, .144, .123], [.186, .159, .181, .135], [.187, .169, .183, .148],
                  [.203, .182, .193, .160]],
    "narco high": [[.138, .125, .131, .113], [.153, .144, .163, .124], [.183, .161, .174, .138], [.179, .169, .175, .152],
                   [.185, .178, .184, .163]],
}  # fmt: skip
"""Table I as printed (Ye et al., MRS 2023): a row a horizon; VRNN, GrAMMI without MI, GrAMMI, CADENCE."""


@dataclass(frozen=True)
class Found:
    """A method on a set: its scores averaged over trainings, the number of these, and their budgets."""

    scores: EpisodeScores
    num_trainings: int
    budgets: tuple[dict[str, Any], ...] = ()


Results = Mapping[str, Mapping[str, Found]]
"""By the name of the set and of the row: a method, with " +goal" where the known hideout is told."""


@dataclass(frozen=True)
class Evaluated:
    """The rows of a set, what distances are divided by, and what a reader must know of its episodes."""

    rows: dict[str, Found]
    scale_m: float
    num_episodes: int
    num_windows: int
    detection_rate: float
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class Duel:
    """A comparison of CADENCE with a rival (or the better of two) over all sets that have both."""

    title: str
    rivals: tuple[str, ...]
    own_goal: bool
    rival_goal: bool
    measure: str
    rival_measure: str


def duels() -> Iterator[Duel]:
    """What the page's summary compares."""
    both = ("grammi_without_mi", "grammi")
    told = {(False, False): "neither is told the hideout", (True, True): "both are", (True, False): "CADENCE alone is"}
    measures = (
        ("displacement_error", "displacement_error", "30 samples"),
        ("displacement_error", "paper_error", "the paper's measure"),
        ("energy_score", "energy_score", "energy score"),
    )
    for (own, rival), words in told.items():
        for measure, other, title in measures:
            yield Duel(f"the better GrAMMI, {title}; {words}", both, own, rival, measure, other)
    for name in ("vrnn", "grammi_without_mi", "grammi", "paper", "library", "library_all", "particle", "cv"):
        for measure, other, title in measures[::2]:
            yield Duel(f"{NAMES[name]}, {title}", (name,), False, False, measure, other)


def row_of(rows: Mapping[str, Found], name: str, goal: bool) -> EpisodeScores | None:
    """A method's scores; where nobody knows a goal, what is told makes no difference."""
    has_goals = any(key.endswith(" +goal") for key in rows)
    found = rows.get(f"{name} +goal" if goal and has_goals else name)
    return None if found is None else found.scores


def summary_rows(results: Results, seed: int) -> list[dict[str, Any]]:
    """Mean leads with intervals, cells won, tied and lost, of every duel for which there is a set with both."""
    rows = []
    for duel in duels():
        own, rivals = {}, {name: {} for name in duel.rivals}
        for key, found in results.items():
            mine = row_of(found, "cadence", duel.own_goal)
            theirs = {name: row_of(found, name, duel.rival_goal) for name in duel.rivals}
            if mine is not None and all(item is not None for item in theirs.values()):
                own[key] = mine
                for name, item in theirs.items():
                    rivals[name][key] = item
        if not own:
            continue
        lists = [list(rivals[name].values()) for name in duel.rivals]
        lead, late = (
            relative_lead(list(own.values()), lists, duel.measure, duel.rival_measure, horizons, seed)
            for horizons in (HORIZONS, LATE)
        )
        cells = [verdicts(own, rivals[name], duel.measure, duel.rival_measure, seed) for name in duel.rivals]
        verdict = {key: [worst(words) for words in zip(*(found[key] for found in cells), strict=True)] for key in own}
        total = count(verdict)
        rows.append({
            "against": duel.title, "sets": list(own), "lead": [lead.value, lead.low, lead.high],
            "lead_from_60_min": [late.value, late.low, late.high], "won": total.won, "tied": total.tied, "lost": total.lost,
            "cells": verdict,
        })  # fmt: skip
    return rows


def worst(words: Sequence[str]) -> str:
    """Against the better of several rivals: won where all are beaten, lost where one is ahead."""
    return "lost" if "lost" in words else "tied" if "tied" in words else "won"


def summary_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """In per cent."""
    lines = [
        line(["CADENCE against", "sets", "mean lead %", "from 60 min on %", "cells won", "tied", "lost"]),
        line(["---"] * 7),
    ]
    for row in rows:
        leads = [with_interval(*(100 * value for value in row[key])) for key in ("lead", "lead_from_60_min")]
        lines.append(line([row["against"], str(len(row["sets"])), *leads, str(row["won"]), str(row["tied"]), str(row["lost"])]))
    return [*lines, ""] if rows else ["There is no checkpoint of CADENCE to compare.", ""]


def cell_table(rows: Sequence[Mapping[str, Any]], title: str) -> list[str]:
    """Every cell of one duel by name."""
    chosen = next((row for row in rows if row["against"].startswith(title)), None)
    if chosen is None:
        return []
    lines = [f"Cells against {chosen['against']}:", "", line(["", *MINUTES]), line(["---"] * 6)]
    return [*lines, *(line([name, *words]) for name, words in chosen["cells"].items()), ""]


def set_section(name: str, found_set: Evaluated, seed: int) -> list[str]:
    """All blocks of one set."""
    rows, scale_m, rate = found_set.rows, found_set.scale_m, 100 * found_set.detection_rate
    lines = [f"## {name}", "", f"{found_set.num_episodes} episodes, detections at {rate:.1f} % of the steps.", ""]
    lines += [*(f"* left out: {reason}" for reason in found_set.left_out), ""] if found_set.left_out else []
    for measure in MEASURES:
        lines += [f"### {TITLES[measure]}: {name}", "", line(["", *MINUTES]), line(["---"] * 6)]
        for key, found in rows.items():
            if key != "truth":
                lines.append(line([label(key, found), *measure_cells(found.scores, measure, scale_m, seed)]))
        lines.append("")
    lines += [
        f"### Steps and obstacles: {name}",
        "",
        line(["", "step m", "states in obstacles %", "segments %"]),
        line(["---"] * 4),
    ]
    for key, found in rows.items():
        total = found.scores.count.sum()
        step, states, segments = (found.scores.share(item).sum() / total for item in SHARES)
        lines.append(line([label(key, found), number(step), number(100 * states), number(100 * segments)]))
    return [*lines, ""]


def measure_cells(scores: EpisodeScores, measure: str, scale_m: float, seed: int) -> list[str]:
    """A measure at every horizon with its interval, over the map side but for coverages."""
    unit = 1.0 if measure.startswith("coverage") else scale_m
    return [with_interval(*(value / unit for value in triple)) for triple in triples(scores, measure, seed)]


def triples(scores: EpisodeScores, measure: str, seed: int) -> list[tuple[float, float, float]]:
    """Value, low and high at every horizon."""
    found = [mean_interval(column, scores, seed, 1000) for column in scores.measure(measure).T]
    return [(item.value, item.low, item.high) for item in found]


def label(key: str, found: Found) -> str:
    """A row's name."""
    name, _, goal = key.partition(" ")
    several = f" (mean of {found.num_trainings} trainings)" if found.num_trainings > 1 else ""
    return NAMES[name] + (", hideout known" if goal else "") + several


def printed_table() -> list[str]:
    """The paper's own numbers."""
    heads = [NAMES[name] for name in (*MIXTURES, "cadence")]
    lines = ["## Printed in the paper", "", "Displacement error over the map side; CADENCE alone was told the hideout.", ""]
    lines += [line(["set", "horizon", *heads]), line(["---"] * 6)]
    for name, rows in PRINTED.items():
        lines += [
            line([name, f"{minutes} ".split()[0], *(f"{value:.3f}" for value in row)])
            for minutes, row in zip(MINUTES, rows, strict=True)
        ]
    return [*lines, ""]


def budget_table(results: Results) -> list[str]:
    """What every training cost, as far as its checkpoint says."""
    lines = ["## Budgets", "", line(["set", "method", "checkpoint", "steps", "windows", "CPU hours"]), line(["---"] * 6)]
    for name, rows in results.items():
        for key, found in rows.items():
            for item in found.budgets if not key.endswith("+goal") else ():
                numbers = ["–" if item[part] is None else f"{item[part]:,}" for part in ("steps", "windows")]
                lines.append(line([name, NAMES[key], item["checkpoint"], *numbers, number(item["cpu_hours"])]))
    return [*lines, ""]


def as_record(found_set: Evaluated, seed: int) -> dict[str, Any]:
    """The numbers of a set as JSON: [value, low, high], over the map side but for coverages; shares as they are."""
    record = {field.name: getattr(found_set, field.name) for field in dataclasses.fields(Evaluated) if field.name != "rows"}
    rows = {}
    for key, found in found_set.rows.items():
        units = {name: 1.0 if name.startswith("coverage") else found_set.scale_m for name in MEASURES}
        values = {
            name: [[value / unit for value in triple] for triple in triples(found.scores, name, seed)]
            for name, unit in units.items()
        }
        shares = {name: found.scores.share(name).sum() / found.scores.count.sum() for name in SHARES}
        rows[key] = {"trainings": found.num_trainings, "budgets": found.budgets, "shares": shares, "values": values}
    return {**record, "rows": rows}


def record(evaluated: Mapping[str, Evaluated], missing: Sequence[str], seed: int) -> dict[str, Any]:
    """table1.json: every number of the page."""
    return {
        "horizons": HORIZONS,
        "printed": PRINTED,
        "sets": {name: as_record(found, seed) for name, found in evaluated.items()},
        "leads": summary_rows({name: found.rows for name, found in evaluated.items()}, seed),
        "not_found": missing,
    }


def page(evaluated: Mapping[str, Evaluated], missing: Sequence[str], command: str, config: ForecastConfig) -> str:
    """table1.md."""
    seed = config.seed
    lines = [
        "# The paper's table I, again", "",
        f"`{command}`", "",
        f"{config.num_windows} random moments of the evaluation episodes of every set, {config.num_hypotheses} hypotheses",
        "each. The true start counts as a detection; after its end a target stays where it was. Distances are over the",
        "map's longer side (2428 cells, 7884 km; the paper does not say what it divides those of narco by). Intervals: 95 %,",
        "bootstrap over episodes. Mixtures are scored by 30 samples and by the paper's measure, which leaves their sigmas out.",
        "Samples of CADENCE and of the mixtures come in mirrored pairs, the library's evenly along its weights: no lead comes",
        "from the way of drawing.",
        "A cell is won or lost where the interval of the paired difference does not hold zero. A lead is one minus the ratio",
        "to the rival, or in every cell to the better one of several.", "",
    ]  # fmt: skip
    blocks = {
        "our worlds": lambda name: not name.startswith("reference"),
        "reference": lambda name: name.startswith("reference"),
    }
    for title, is_in in blocks.items():
        results = {name: found.rows for name, found in evaluated.items() if is_in(name)}
        if results:
            rows = summary_rows(results, seed)
            lines += [f"## Leads: {title}", "", *summary_table(rows)]
            for start in ("the better GrAMMI, 30 samples; neither", "the better GrAMMI, energy score; neither", "VRNN, energy"):
                lines += cell_table(rows, start)
    lines += printed_table()
    for name, found in evaluated.items():
        lines += set_section(name, found, seed)
    lines += budget_table({name: found.rows for name, found in evaluated.items()})
    if missing:
        lines += ["## Not found", "", *(f"* {item}" for item in missing), ""]
    return "\n".join(lines).rstrip() + "\n"
