"""What the reliability of answers is told as: tables and the section of docs/benchmarks/answers.md."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import publishing
from benchmarks.publishing import Measurement
from cadence.arrays import Float64s
from cadence.metrics import bootstrap_mean

NUM_BINS = 10
OPEN = (0.02, 0.98)
"""Questions that are open: at least one estimator's stories of a log disagree about them."""


def tables(
    told: Mapping[tuple[str, str], Sequence[Any]], maps: Mapping[tuple[str, str], Sequence[tuple[str, float]]]
) -> dict[str, list[publishing.Row]]:
    """Numbers a log and estimator, and what was said against what was by tenths of probability."""
    rows, bins = [], []
    logs = list(dict.fromkeys(log for log, _ in told))
    names = list(dict.fromkeys(name for _, name in told))
    for log in [*logs, "all"]:
        for name in names:
            chosen = [key for key in told if key[1] == name and log in (key[0], "all")]
            answers = [answer for key in chosen for answer in told[key]]
            scores = [score for key in chosen for score in maps[key]]
            rows.append({"log": log, "estimator": name, **_numbers(answers), **_map_numbers(scores)})
            bins += [{"log": log, "estimator": name, **row} for row in _bins(answers)]
    return {"reliability": rows, "reliability_bins": bins}


def _numbers(answers: Sequence[Any]) -> publishing.Row:
    rng = np.random.default_rng(0)
    said, was, group = _columns(answers)
    if not len(said):
        empty = {
            **publishing.columns("brier", None),
            "calibration_error": None,
            "calibration_error_low": None,
            "calibration_error_high": None,
        }
        return {
            "num_questions": 0,
            "share_open": None,
            "share_so": None,
            "calibration_error_by_chance": None,
            **empty,
            "num_arrivals": 0,
            **publishing.columns("arrival_held", None),
        }
    errors = [calibration_error(said, was)] + [calibration_error(said[rows], was[rows]) for rows in _resampled(group, rng, 500)]
    arrivals = [answer for answer in answers if answer.arrived_s is not None]
    held = np.array([answer.arrival_low_s <= answer.arrived_s <= answer.arrival_high_s for answer in arrivals], dtype=float)
    low, high = np.percentile(errors[1:], [2.5, 97.5])
    return {
        "num_questions": len(said), "share_so": float(was.mean()),
        "share_open": float(((said > OPEN[0]) & (said < OPEN[1])).mean()),
        **publishing.columns("brier", bootstrap_mean((said - was) ** 2, group, rng)),
        "calibration_error_by_chance": error_by_chance(said, rng),
        "calibration_error": errors[0], "calibration_error_low": float(low), "calibration_error_high": float(high),
        "num_arrivals": len(arrivals),
        **publishing.columns("arrival_held", bootstrap_mean(held, [a.group for a in arrivals], rng) if len(arrivals) else None),
    }  # fmt: skip


def _map_numbers(scores: Sequence[tuple[str, float]]) -> publishing.Row:
    if not scores:
        return publishing.columns("map_score", None)
    groups, values = zip(*scores, strict=True)
    return publishing.columns("map_score", bootstrap_mean(values, groups, np.random.default_rng(0)))


def calibration_error(said: Float64s, was: Float64s) -> float:
    """Expected calibration error: over tenths of probability, how far the mean said is from the share that was so."""
    place = np.minimum((said * NUM_BINS).astype(int), NUM_BINS - 1)
    total = np.bincount(place, said - was, NUM_BINS)
    return float(np.abs(total).sum() / len(said))


def error_by_chance(said: Float64s, rng: np.random.Generator, count: int = 200) -> float:
    """Mean calibration error of so many questions if all happened exactly as often as is said."""
    return float(np.mean([calibration_error(said, (rng.random(len(said)) < said).astype(np.float64)) for _ in range(count)]))


def _bins(answers: Sequence[Any]) -> list[publishing.Row]:
    said, was, _ = _columns(answers)
    place = np.minimum((said * NUM_BINS).astype(int), NUM_BINS - 1)
    rows = []
    for number in range(NUM_BINS):
        mine = place == number
        if mine.any():
            rows.append(
                {"bin": number, "num": int(mine.sum()), "said": float(said[mine].mean()), "was": float(was[mine].mean())}
            )
    return rows


def _columns(answers: Sequence[Any]) -> tuple[Float64s, Float64s, Sequence[str]]:
    said = np.array([answer.probability for answer in answers], dtype=np.float64)
    was = np.array([answer.is_so for answer in answers], dtype=np.float64)
    return said, was, [answer.group for answer in answers]


def _resampled(group: Sequence[str], rng: np.random.Generator, count: int) -> list[Any]:
    """Rows of `count` resamples of whole groups."""
    _, number = np.unique(group, return_inverse=True)
    members = [np.flatnonzero(number == index) for index in range(number.max() + 1)]
    return [np.concatenate([members[index] for index in rng.integers(len(members), size=len(members))]) for _ in range(count)]


def section(measured: Measurement) -> str:
    """Tables for the page: each log, all estimators."""
    heads = (
        "log",
        "answers of",
        "questions",
        "open",
        "so",
        "calibration error",
        "by chance",
        "Brier score",
        "arrival in 90 %",
        "MapScore",
    )
    rows = []
    for row in measured.rows():
        if row["estimator"] == "hold" and row["log"] != "all":
            continue  # far behind everywhere; the files have it
        if row["estimator"] == "ring":
            rows.append(
                [row["log"], "distance rings", "", "", "", "", "", "", "", publishing.interval(row, "map_score", ".4f")]
            )
            continue
        rows.append([
            row["log"], row["estimator"], str(row["num_questions"]),
            f"{100 * row['share_open']:.0f} %", f"{100 * row['share_so']:.0f} %",
            publishing.interval(row, "calibration_error", ".3f"), f"{row['calibration_error_by_chance']:.3f}",
            publishing.interval(row, "brier", ".4f"),
            _percent(row, "arrival_held", row["num_arrivals"]), publishing.interval(row, "map_score", ".4f"),
        ])  # fmt: skip
    return publishing.table(heads, rows)


def _percent(row: publishing.Row, name: str, count: int) -> str:
    if row[name] is None:
        return "–"
    ends = "" if row[f"{name}_low"] is None else f" [{100 * row[f'{name}_low']:.0f}, {100 * row[f'{name}_high']:.0f}]"
    return f"{100 * row[name]:.0f} %{ends} of {count}"
