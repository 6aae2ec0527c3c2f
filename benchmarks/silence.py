"""What silence of sensors tells: hypotheses of recorded prison episodes weighed by where nobody saw the target.

Windows whose last detection is old, of the recorded episodes of the original simulator. P(detect) over distance and the
exponent come from other episodes. Each estimator is compared with itself without silence, window by window.

    python -m benchmarks.silence --reference ../shared/data/prison_reference --work out/silence --publish docs

What a log gave is kept in the work folder, so that a killed call goes on where it was.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks import publishing
from benchmarks.silence_episodes import (
    KINDS,
    STEP_S,
    RecordedEpisode,
    fit_curves,
    looks_of,
    read_coverage,
    read_episode,
)
from cadence.arrays import Float64s
from cadence.constraints.obstacles import Obstacles
from cadence.evidence.estimator import WeighingConfig, WithEvidence
from cadence.evidence.footprints import DetectionCurve
from cadence.evidence.silence import Silence, ground_of
from cadence.metrics import coverage as coverage_of
from cadence.metrics import energy_score
from cadence.metrics.bootstrap import Interval, bootstrap_mean, bootstrap_ratio
from cadence.types import HypothesisSet, WindowBatch
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import Samplings
from pipeline.grids import GridConfig, plan_grid
from pipeline.windows import build_windows

NAME = "silence"
SETS = ("low", "med")
EXPONENTS = {"none": (0.3, 0.6, 1.0), "prison": (0.6,)}
OLD_STEPS = 15
LATER = 30
FIT, TUNED_ON, TEST = slice(0, 30), slice(60, 63), slice(150, 298)
"""Logs of a set, by their order: curves are fitted on the first, the exponent was chosen on the second, the last are scored."""
EXPONENT = 0.6
LEAST_TOLD = 0.25
"""Share of the windows, those with the smallest effective sample size, in which silence says most."""
NUM_HYPOTHESES = 30


@dataclass(frozen=True)
class Asked:
    """One run: estimator, kinds of sensors that are heard, exponent (0: none)."""

    checkpoint: str
    kinds: tuple[str, ...]
    exponent: float


def asked_runs(checkpoints: Sequence[str], exponents: Sequence[float]) -> list[Asked]:
    """Without silence, and with that of all sensors; of a checkpoint of the place also with that of moving ones alone."""
    runs = []
    for checkpoint in checkpoints:
        runs.append(Asked(checkpoint, (), 0.0))
        choices = (KINDS, KINDS[1:]) if checkpoint == "prison" else (KINDS,)
        runs += [Asked(checkpoint, kinds, exponent) for kinds in choices for exponent in exponents]
    return runs


def measure_log(
    path: Path, checkpoints: Sequence[str], exponents: Sequence[float], curves: dict[str, DetectionCurve], reference: Path
) -> list[publishing.Row]:
    """A row for each old window and run of one log."""
    torch.set_num_threads(1)
    episode, coverage = read_episode(path), read_coverage(reference)
    rows: list[publishing.Row] = []
    if episode.is_detected.sum() < 3:
        return rows
    seen = np.flatnonzero(episode.is_detected)
    ground = ground_of(looks_of(episode, curves, coverage), seen * STEP_S, episode.truth_m[seen])
    for checkpoint in checkpoints:
        loaded = load_estimator(checkpoint, Samplings(device="cpu"))
        table = episode.detections()
        grid = plan_grid(table, loaded.grid(GridConfig(step_s=STEP_S)))
        windows = build_windows(table, grid, 0)
        fitted = loaded.fitted(FittingData.of(table, grid, windows)).estimator
        steps = np.round((windows.origins_ns - episode.start_ns) * 1e-9 / STEP_S).astype(np.int64)
        age = -torch.where(windows.batch.detections.is_observed, windows.batch.detections.time_s, -torch.inf).amax((1, 2))
        is_old = (age.numpy() >= OLD_STEPS * STEP_S) & (steps < len(episode.truth_m)) & windows.batch.is_active[:, 0].numpy()
        chosen = torch.from_numpy(np.flatnonzero(is_old))
        if not len(chosen):
            continue
        for run in asked_runs([checkpoint], exponents):
            heard = looks_of(episode, curves, coverage, run.kinds)
            evidence = (Silence(heard, run.exponent, ground=ground),) if run.kinds else ()
            batch = windows.located(episode.start_ns, Obstacles.none(), evidence).batch[chosen]
            weighed = WithEvidence(fitted, WeighingConfig(), loaded.is_apart, loaded.num_past)
            begun_s = time.process_time()
            found = weighed.sample(batch, NUM_HYPOTHESES)
            taken_s = (time.process_time() - begun_s) / len(chosen)
            for row, index in enumerate(chosen.tolist()):
                rows.append(
                    {
                        "set": path.parent.name, "log": path.stem, "checkpoint": checkpoint, "sensors": "+".join(run.kinds),
                        "exponent": run.exponent, "window": index, "age": float(age[index]) / STEP_S, "cpu_s": taken_s,
                    }
                    | scores(found, batch, row, episode, int(steps[index]), windows.datum_m[index])
                )  # fmt: skip
    return rows


def scores(
    found: HypothesisSet, batch: WindowBatch, row: int, episode: RecordedEpisode, origin: int, datum_m: Float64s
) -> publishing.Row:
    """Energy scores of one window now, since the last detection, at undetected steps of the past, later; coverage; ranks."""
    index = origin + np.arange(batch.num_steps) - batch.origin_index
    is_known = (index >= 0) & (index < len(episode.truth_m))
    truth_m = torch.from_numpy(episode.truth_m[np.clip(index, 0, len(episode.truth_m) - 1)] - datum_m)[None, None]
    position_m, weight = found.position_m[row : row + 1].double(), found.weight[row : row + 1].double()
    score = energy_score(position_m, weight, truth_m)[0, 0].numpy()
    now = batch.origin_index
    inside = coverage_of(position_m[..., now : now + 1, :], weight, truth_m[..., now : now + 1, :], (0.9,))[0]
    is_dark = ~episode.is_detected[np.clip(index, 0, len(episode.truth_m) - 1)]
    is_past = is_known & is_dark & (np.arange(batch.num_steps) <= now)
    last = np.flatnonzero(is_known & ~is_dark & (np.arange(batch.num_steps) <= now))
    since = is_past & (np.arange(batch.num_steps) > (last[-1] if len(last) else -1))
    error = (position_m[0, :, 0, now] - truth_m[0, 0, now]).norm(dim=-1).numpy()
    ahead = now + LATER
    return {
        "now": float(score[now]),
        "since": float(score[since].mean()) if since.any() else float("nan"),
        "past": float(score[is_past].mean()) if is_past.any() else float("nan"),
        "later": float(score[ahead]) if ahead < len(score) and is_known[ahead] else float("nan"),
        "inside": float(inside.reshape(-1)[0]),
        "num_effective": float("nan") if found.num_effective is None else float(found.num_effective[row, 0]),
        "status": found.status[row][0],
        "spearman": spearman(weight[0].numpy(), -error),
    }


def spearman(first: Float64s, second: Float64s) -> float:
    """Rank correlation; NaN where one of them is constant."""
    if np.ptp(first) < 1e-12:
        return float("nan")
    ranks = [_ranks(values) for values in (first, second)]
    return float(np.corrcoef(*ranks)[0, 1])


def _ranks(values: Float64s) -> Float64s:
    """Mean ranks."""
    _, number, count = np.unique(values, return_inverse=True, return_counts=True)
    middle = np.cumsum(count) - 0.5 * (count - 1)
    return np.asarray(middle[number])


def measured_rows(reference: Path, work: Path, num_logs: dict[str, list[int]]) -> list[publishing.Row]:
    """The rows of the first so many test logs of each set, by checkpoint; those that were kept are not measured again."""
    rows: list[publishing.Row] = []
    work.mkdir(parents=True, exist_ok=True)
    for which, name in enumerate(SETS):
        logs = sorted((reference / name).glob("*.mcap"))
        curves: dict[str, DetectionCurve] = {}
        for checkpoint, nums in num_logs.items():
            for path in logs[TEST][: nums[which]]:
                kept = work / f"{path.stem}_{checkpoint}.json"
                if not kept.is_file():
                    curves = curves or fit_curves([read_episode(log) for log in logs[FIT]], read_coverage(reference))
                    found = measure_log(path, [checkpoint], EXPONENTS[checkpoint], curves, reference)
                    kept.write_text(json.dumps(found), encoding="utf-8")
                rows += json.loads(kept.read_text(encoding="utf-8"))
    return rows


def summary(rows: Sequence[publishing.Row]) -> list[publishing.Row]:
    """Each run beside the same estimator without silence, on the same windows; intervals over logs."""
    plain = {(row["checkpoint"], row["log"], row["window"]): row for row in rows if row["exponent"] == 0}
    runs = sorted({(row["checkpoint"], row["sensors"], row["exponent"]) for row in rows if row["exponent"] > 0})
    found = []
    for checkpoint, sensors, exponent in runs:
        asked = (checkpoint, sensors, exponent)
        own = [row for row in rows if (row["checkpoint"], row["sensors"], row["exponent"]) == asked]
        before = [plain[checkpoint, row["log"], row["window"]] for row in own]
        effective = np.array([row["num_effective"] for row in own], dtype=float)
        told = effective <= np.nanquantile(effective, LEAST_TOLD)
        line: publishing.Row = {"checkpoint": checkpoint, "sensors": sensors, "exponent": exponent, "windows": len(own)}
        line |= {"logs": len({row["log"] for row in own}), "num_effective": float(np.nanmedian(effective))}
        for column in ("now", "since", "past", "later"):
            line |= publishing.columns(column, _ratio(own, before, column))
        some = [row for row, is_told in zip(own, told, strict=True) if is_told]
        line |= publishing.columns("told", _ratio(some, [b for b, is_told in zip(before, told, strict=True) if is_told], "now"))
        for name, group in (("inside", own), ("inside_before", before)):
            line |= publishing.columns(name, _mean(group, "inside"))
        line |= publishing.columns("spearman", _mean(own, "spearman"))
        line |= publishing.columns("cost", _ratio(own, before, "cpu_s"))
        found.append(line)
    return found


def _values(rows: Sequence[publishing.Row], column: str) -> tuple[Float64s, list[str]]:
    return np.array([row[column] for row in rows], dtype=float), [row["log"] for row in rows]


def _ratio(own: Sequence[publishing.Row], before: Sequence[publishing.Row], column: str) -> Interval:
    (top, logs), (bottom, _) = _values(own, column), _values(before, column)
    return bootstrap_ratio(top, bottom, logs, np.random.default_rng(0))


def _mean(rows: Sequence[publishing.Row], column: str) -> Interval:
    return bootstrap_mean(*_values(rows, column), np.random.default_rng(0))


def section(measured: publishing.Measurement) -> str:
    """The table."""
    names = {"none": "bank", "prison": "`prison`"}
    lines = []
    for row in measured.rows():
        num_kinds = len(str(row["sensors"]).split("+"))
        sensors = "all" if num_kinds == len(KINDS) else "moving"
        lines.append(
            [
                names[row["checkpoint"]], sensors, f"{row['exponent']:g}", f"{row['windows']} / {row['logs']}",
                *(publishing.interval(row, column, ".2f") for column in ("now", "past", "later", "told")),
                f"{100 * row['inside_before']:.0f} → {100 * row['inside']:.0f} %", publishing.interval(row, "spearman", ".2f"),
                f"{row['cost']:.1f}",
            ]
        )  # fmt: skip
    heads = (
        "hypotheses",
        "sensors",
        "exponent",
        "windows / logs",
        "now",
        "undetected past",
        "+30 steps",
        "now, where it says most",
    )
    return publishing.table((*heads, "90 % region", "Spearman", "CPU of sampling"), lines)


def main() -> int:
    """Measure, print, publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--work", type=Path, default=Path("out/silence"))
    parser.add_argument("--bank-logs", type=int, nargs=2, default=[12, 12], help="test logs of low and of med")
    parser.add_argument("--place-logs", type=int, nargs=2, default=[24, 24], help="test logs of low and of med")
    parser.add_argument("--publish", type=Path)
    arguments = parser.parse_args()
    rows = measured_rows(arguments.reference, arguments.work, {"none": arguments.bank_logs, "prison": arguments.place_logs})
    facts = publishing.facts_of(NAME) | {"seed": 0, "hypotheses": NUM_HYPOTHESES, "fitted_on": "logs 0 to 29 of each set"}
    facts |= {"tuned_on": "logs 60 to 62", "scored": "logs from 150 on"}
    clean = [{key: None if isinstance(v, float) and math.isnan(v) else v for key, v in row.items()} for row in rows]
    tables = {NAME: summary(rows), f"{NAME}_windows": clean}
    publishing.publish(publishing.Measurement(NAME, facts, tables), section, arguments.publish)
    return 0


if __name__ == "__main__":
    sys.exit(main())
