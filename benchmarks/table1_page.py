"""What `table1.py` publishes: leads over the rivals, cells won and lost, errors in every set, what the trainings cost."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks import publishing
from benchmarks.leads import count, relative_lead, verdicts
from benchmarks.publishing import Measurement
from pipeline.forecast.scores import HORIZONS, MEASURES, SHARES, EpisodeScores
from pipeline.forecast.tables import mean_interval

MIXTURES = ("vrnn", "grammi_without_mi", "grammi")
MINUTES = (0, 30, 60, 90, 120)
"""What the paper calls the horizons."""
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
EPISODES = {
    "our worlds": lambda name: not name.startswith("reference"),
    "reference": lambda name: name.startswith("reference"),
}
"""Kinds of sets, which are compared apart."""
SHOWN_AS = {"our worlds": "rebuilt worlds", "reference": "recorded"}
SHOWN = (
    "the better GrAMMI, energy score; neither is told the hideout",
    "the better GrAMMI, energy score; CADENCE alone is",
    "the better GrAMMI, the paper's measure; CADENCE alone is",
    "VRNN, energy score",
    "library, energy score",
    "library, all episodes, energy score",
)
"""Rows of the page."""


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


def compared(results: Results, episodes: str, seed: int) -> tuple[list[publishing.Row], list[publishing.Row]]:
    """Mean leads and numbers of cells of every duel for which there is a set with both, and every cell by itself."""
    leads, cells = [], []
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
        words = [verdicts(own, rivals[name], duel.measure, duel.rival_measure, seed) for name in duel.rivals]
        verdict = {key: [worst(both) for both in zip(*(found[key] for found in words), strict=True)] for key in own}
        total, what = count(verdict), {"episodes": episodes, "against": duel.title}
        leads.append({
            **what, "num_sets": len(own), **publishing.columns("lead_percent", lead, 100),
            **publishing.columns("lead_from_60_min_percent", late, 100),
            "won": total.won, "tied": total.tied, "lost": total.lost,
        })  # fmt: skip
        cells += [
            {**what, "set": key, "horizon_min": minutes, "verdict": word}
            for key, row in verdict.items()
            for minutes, word in zip(MINUTES, row, strict=True)
        ]
    return leads, cells


def worst(words: Sequence[str]) -> str:
    """Against the better of several rivals: won where all are beaten, lost where one is ahead."""
    return "lost" if "lost" in words else "tied" if "tied" in words else "won"


def tables(name: str, evaluated: Mapping[str, Evaluated], seed: int) -> dict[str, list[publishing.Row]]:
    """All numbers."""
    found: dict[str, list[publishing.Row]] = {kind: [] for kind in ("leads", "cells", "errors", "motion", "budgets", "sets")}
    for episodes, is_in in EPISODES.items():
        results = {key: item.rows for key, item in evaluated.items() if is_in(key)}
        if results:
            leads, cells = compared(results, episodes, seed)
            found["leads"] += leads
            found["cells"] += cells
    for key, item in evaluated.items():
        found["errors"] += error_rows(key, item, seed)
        found["motion"] += motion_rows(key, item)
        found["budgets"] += budget_rows(key, item)
        rate = 100 * item.detection_rate
        found["sets"].append({"set": key, "num_episodes": item.num_episodes, "detection_rate_percent": rate})
    found["printed"] = [
        {"set": key, "horizon_min": minutes, "method": NAMES[method], "displacement_error": value}
        for key, rows in PRINTED.items()
        for minutes, row in zip(MINUTES, rows, strict=True)
        for method, value in zip((*MIXTURES, "cadence"), row, strict=True)
    ]
    return {f"{name}_{kind}": rows for kind, rows in found.items() if rows}


def error_rows(key: str, item: Evaluated, seed: int) -> Iterator[publishing.Row]:
    """All measures at all horizons with their intervals, over the map side but for coverages."""
    for row, found in item.rows.items():
        if row != "truth":
            for measure in MEASURES:
                for values in measure_rows(found.scores, measure, item.scale_m, seed):
                    yield {"set": key, **of_row(row), "measure": measure, **values}


def measure_rows(
    scores: EpisodeScores, measure: str, scale_m: float, seed: int, num_resamples: int = 1000
) -> Iterator[publishing.Row]:
    """A measure by horizon."""
    unit = 1.0 if measure.startswith("coverage") else scale_m
    for minutes, column in zip(MINUTES, scores.measure(measure).T, strict=True):
        found = mean_interval(column / unit, scores, seed, num_resamples)
        yield {"horizon_min": minutes, **publishing.columns("value", found)}


def motion_rows(key: str, item: Evaluated) -> Iterator[publishing.Row]:
    """Mean length of a step, and what lies in obstacles."""
    for row, found in item.rows.items():
        total = found.scores.count.sum()
        step, states, segments = (found.scores.share(name).sum() / total for name in SHARES)
        yield {
            "set": key, **of_row(row), "step_m": step, "states_in_obstacles_percent": 100 * states,
            "segments_in_obstacles_percent": 100 * segments,
        }  # fmt: skip


def budget_rows(key: str, item: Evaluated) -> Iterator[publishing.Row]:
    """What every training cost, as far as its checkpoint says."""
    for row, found in item.rows.items():
        if not row.endswith("+goal"):
            yield from ({"set": key, "method": NAMES[row], **budget} for budget in found.budgets)


def of_row(row: str) -> publishing.Row:
    """Which method it is, and whether it was told the hideout."""
    name, _, goal = row.partition(" ")
    return {"method": NAMES[name], "is_hideout_told": "yes" if goal else "no"}


def section(measured: Measurement) -> str:
    """Leads over the main rivals, how often the truth is in the region, and what the trainings cost."""
    words = []
    for told in ("no", "yes"):
        rows = measured.rows("errors", method=NAMES["cadence"], measure="coverage_90", is_hideout_told=told)
        shares = [100 * row["value"] for row in rows]
        words.append(f"{min(shares):.0f} to {max(shares):.0f} %" if shares else "–")
    budgets = budget_words(measured, ("prison low", "narco low"), ("cadence", "grammi", "vrnn"))
    text = (
        f"{measured.facts['num_windows']} moments a set. CADENCE's 90 % region holds {words[0]} of the truth by set and "
        f"horizon, {words[1]} with the hideout told. Trained on {budgets}."
    )
    return f"{lead_table(measured, SHOWN)}\n\n{text}"


def lead_table(measured: Measurement, shown: Sequence[str]) -> str:
    """Mean lead, and cells won, tied and lost; dashes where nothing was compared."""
    heads = ["CADENCE ahead of", *(f"{name}: {what}" for name in SHOWN_AS.values() for what in ("%", "cells"))]
    lines = []
    for against in shown:
        cells = []
        for episodes in SHOWN_AS:
            rows = measured.rows("leads", episodes=episodes, against=against)
            for row in rows:
                cells += [publishing.interval(row, "lead_percent", ".0f"), f"{row['won']}/{row['tied']}/{row['lost']}"]
            cells += [] if rows else ["–"] * 2
        lines.append([against.removesuffix("; neither is told the hideout"), *cells])
    return publishing.table(heads, lines)


def budget_words(measured: Measurement, sets: Sequence[str], methods: Sequence[str]) -> str:
    """Windows and processor time of trainings whose checkpoints state them, set by set."""
    parts = []
    for key in sets:
        rows = [row for method in methods for row in measured.rows("budgets", set=key, method=NAMES[method])]
        stated = [row for row in rows if row["num_windows"] is not None and row["cpu_hours"] is not None]
        words = [f"{row['method']} {row['num_windows'] / 1e6:.1f} ({row['cpu_hours']:.1f} h)" for row in stated]
        parts += [f"{key.split()[0]} {', '.join(words)}"] if words else []
    return "; ".join(parts) + " million windows (CPU hours)"
