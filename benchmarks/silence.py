"""What silence of sensors tells: hypotheses of recorded prison episodes weighed by where nobody saw the target.

Windows whose last detection is old, of the recorded episodes of the original simulator. P(detect) over distance and the
exponent come from other episodes. Each estimator is compared with itself without silence, window by window.

    python -m benchmarks.silence --reference ../shared/data/prison_reference --publish docs
"""

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
    looks_of,
    read_coverage,
    read_episode,
)
from cadence.arrays import Float64s
from cadence.constraints.obstacles import Obstacles
from cadence.evidence.estimator import WeighingConfig, WithEvidence
from cadence.evidence.footprints import DetectionCurve
from cadence.evidence.silence import Silence
from cadence.metrics import coverage as coverage_of
from cadence.metrics import energy_score
from cadence.types import HypothesisSet, WindowBatch
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import Samplings
from pipeline.grids import GridConfig, plan_grid
from pipeline.windows import build_windows

NAME = "silence"
SETS = ("low", "med")
EXPONENTS = (0.3, 0.6, 1.0)
OLD_STEPS = 15
LATER = 30
FIT, TUNE, TEST = slice(0, 60), slice(60, 110), slice(150, 298)
"""Logs of a set, by their order: curves are fitted on the first, the exponent is chosen on the second."""
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
            evidence = (Silence(looks_of(episode, curves, coverage, run.kinds), run.exponent),) if run.kinds else ()
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
