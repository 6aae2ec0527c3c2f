"""Which estimator reconstructs and predicts real tracks best from few detections?

Real flight, ship and aircraft tracks (../shared/data) are thinned to bursts of detections, several times with different seeds;
every estimator is fitted to the detections alone and scored on the same windows against the whole track. One JSON file per
log, rate, seed and estimator in the work folder: a killed run goes on where it was, and one estimator can be done again alone
(--again NAME).

    python -m benchmarks.real_logs --publish docs
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks import publishing
from benchmarks.publishing import Measurement
from benchmarks.real_logs_page import OWN, SHOWN, Row, draw_chart, section
from cadence.baselines.kalman import RandomWalkKalman
from cadence.errors import CadenceError
from cadence.metrics import bootstrap_ratio
from cadence.types import Estimator
from pipeline.checkpoints import DEFAULT
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import GeneralSampling, Samplings
from pipeline.evaluate.rivals import RIVALS
from pipeline.extract.config import ExtractConfig
from pipeline.extract.stage import extract
from pipeline.extract.thinning import ThinningConfig
from pipeline.files import write_atomic
from pipeline.grids import GridConfig, plan_grid
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.mapping.sources import SourceConfig
from pipeline.progress import Progress
from pipeline.scoring.case import default_truth_gap_s
from pipeline.scoring.scores import METRICS, PARTS, Cells, compare, groups_of
from pipeline.tables import read_table
from pipeline.windows import MissionWindows, build_windows, truth_on_grid

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
WORK = Path("out/benchmarks/real_logs")
RATES = (0.05, 0.12, 0.30)
REFERENCES = ("cv", "ou", "walk", "linear", "hold")
"""The best of these in a cell, once all are known, is what others are compared with there."""
LOGS = ("flight", "ships", "aircraft", "adsb")
RESULT_VERSION = 2


@dataclass(frozen=True)
class Case:
    """A log, its dense channel, the mean length of a burst of detections, and the steps from one window to the next."""

    name: str
    path: str
    truth: SourceConfig
    mean_burst_s: float
    stride_steps: int

    def gap_s(self, rate: float) -> float:
        """Mean gap between bursts at a rate of detections."""
        return self.mean_burst_s * (1.0 - rate) / rate

    def step_s(self, rate: float) -> float:
        """A sixteenth of the gap in which a random moment lies, as infer would choose it, but the same for all seeds.

        1.68 is the median of a gap's length over its mean, gaps being exponential and taken as often as they are long.
        """
        return float(f"{1.68 * self.gap_s(rate) / 16.0:.2g}")


def _adsb(flight: str, mean_burst_s: float) -> Case:
    return Case(flight, f"flights/adsb/{flight}.mcap", SourceConfig("/truth/{agent}"), mean_burst_s, 16)


CASES: Mapping[str, tuple[Case, ...]] = {
    "flight": (Case("flight", "flights/cubs2_cub_stabilize.mcap", SourceConfig("/cub1/pose", agent="cub1"), 1.0, 4),),
    "ships": (Case("ships", "maritime/solent_ais_known.mcap", SourceConfig("/truth/{agent}"), 20.0, 16),),
    "aircraft": (Case("aircraft", "flights/calfire_adsb_known.mcap", SourceConfig("/truth/{agent}"), 60.0, 16),),
    # Every second of 14 flights by name: nothing was tuned on these. A burst lasts a two-hundredth of the flight, at least 3 s.
    "adsb": (
        _adsb("bornholm", 64.0), _adsb("easter_rabbit", 41.0), _adsb("funchal", 69.0), _adsb("indiana", 93.0),
        _adsb("luberon", 131.0), _adsb("rega_zh", 3.0), _adsb("sydney", 74.0),
    ),
    # The others: bank, pool and spread were chosen on these, and on seeds from 10 on of the three logs above.
    "adsb_tuning": (
        _adsb("border_control", 73.0), _adsb("cevennes", 121.0), _adsb("franconia", 135.0), _adsb("ign_mercantour", 64.0),
        _adsb("kiruna", 42.0), _adsb("pixair_toulouse", 84.0), _adsb("samu31", 3.0),
    ),
}  # fmt: skip
"""Logs whose agents are pooled, by the name that tables give them."""


def _model(data: FittingData, checkpoint: str, is_gated: bool) -> Estimator:
    samplings = Samplings(general=GeneralSampling(is_gated=is_gated))
    return load_estimator(checkpoint, samplings).fitted(data).estimator


LOG_RIVALS: Mapping[str, Callable[[FittingData], Estimator]] = {
    **RIVALS,
    "walk": lambda data: RandomWalkKalman().fit(data.tracks, data.grid.step_s).tuned(data.tests),
}
"""The rivals of `cadence evaluate`, and a random walk, tuned like the Kalman smoothers."""
UNGATED = "network"
"""Cadence without its gate: the network takes part whatever hindsight says of it."""
ESTIMATORS = (OWN, UNGATED, *LOG_RIVALS)


@dataclass(frozen=True)
class Setting:
    """One thinned recording of a log of the tables."""

    log: str
    case: Case
    rate: float
    seed: int

    @property
    def folder(self) -> str:
        """Where its files lie in the work folder."""
        return f"{self.case.name}/rate{100 * self.rate:02.0f}_seed{self.seed}"


@dataclass(frozen=True)
class Result:
    """One estimator on one thinned log: sums and counts of every metric by group and part.

    sums, counts  {part: {metric: [a number a group]}} in the order of `groups`
    """

    version: int
    estimator: str
    log: str
    case: str
    rate: float
    seed: int
    num_hypotheses: int
    step_s: float
    num_windows: int
    num_detections: int
    max_truth_gap_s: float
    fit_s: float
    score_s: float
    groups: list[str]
    sums: dict[str, dict[str, list[float]]]
    counts: dict[str, dict[str, list[int]]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the table, and publish it where asked to."""
    options = _parser().parse_args(arguments)
    if not DATA.is_dir():
        print(f"skipped: {DATA} is not here")
        return 0
    progress = Progress(quiet=options.quiet)
    settings = [
        Setting(log, case, rate, seed)
        for log in options.logs for case in CASES[log] for rate in options.rates for seed in options.seeds
    ]  # fmt: skip
    for setting in settings if not options.as_it_stands else ():
        run_setting(setting, options, progress)
    results = [_load(options.work, s, name, options.hypotheses) for s in settings for name in options.estimators]
    found = [result for result in results if result is not None]
    rows = table(found)
    measured = Measurement(
        "real_logs",
        publishing.facts_of("real_logs", arguments) | {"num_hypotheses": options.hypotheses, "checkpoint": options.checkpoint},
        tables(rows, found),
    )
    print(publishing.as_csv(measured.rows()), end="")
    if options.publish is not None:
        publishing.publish(measured, section, options.publish)
        draw_chart(rows, options.publish / "images" / "real_logs.png")
    return 0


def run_setting(setting: Setting, options: argparse.Namespace, progress: Progress) -> None:
    """Score the estimators that have no result yet for one thinned log."""
    work, num_hypotheses = options.work, options.hypotheses
    missing = [n for n in options.estimators if n in options.again or _load(work, setting, n, num_hypotheses) is None]
    if not missing:
        return
    directory = work / setting.folder
    prepare(setting, directory, progress)
    detections, _ = read_table(directory / "detections.parquet", "detections")
    truth, _ = read_table(directory / "truth.parquet", "truth")
    case = setting.case
    grid = plan_grid(detections, GridConfig(step_s=case.step_s(setting.rate), stride_steps=case.stride_steps))
    windows = build_windows(detections, grid, setting.seed)
    max_gap_s = default_truth_gap_s(truth, grid.step_s)
    truth_m, is_known = truth_on_grid(truth, windows, max_gap_s)
    data = FittingData.of(detections, grid, windows)
    some = evenly_spread(windows.batch.is_active, options.most_tracks)
    asked = windows.batch[some], truth_m[some], is_known[some], num_hypotheses
    for name in missing:
        begin = time.perf_counter()
        estimator = LOG_RIVALS[name](data) if name in LOG_RIVALS else _model(data, options.checkpoint, name == OWN)
        fitted = time.perf_counter()
        with progress.bar(len(some), f"{setting.folder} {name}", "window") as bar:
            cells = compare({name: estimator}, *asked, None, bar.update)[name]
        groups, sums, counts = _grouped(cells, windows, len(some))
        result = Result(
            RESULT_VERSION, name, setting.log, setting.case.name, setting.rate, setting.seed, num_hypotheses, grid.step_s,
            len(some), detections.num_rows, max_gap_s, fitted - begin, time.perf_counter() - fitted, groups,
            sums, counts,
        )  # fmt: skip
        write_atomic(_path(work, setting, name, num_hypotheses), json.dumps(asdict(result)))


def prepare(setting: Setting, directory: Path, progress: Progress) -> None:
    """Ingest the log and thin its dense channel into detections; skipped where it is done."""
    case = setting.case
    gap_s = case.gap_s(setting.rate)
    thinning = ThinningConfig(enabled=True, seed=setting.seed, mean_gap_s=gap_s, mean_burst_s=case.mean_burst_s)
    quiet = Progress(quiet=True)
    ingest(DATA / case.path, directory, IngestConfig(), quiet)
    extract(directory, ExtractConfig(truth=(case.truth,), suggest=False, thinning=thinning), quiet)
    progress.note(f"{setting.folder}: thinned, bursts of {case.mean_burst_s:g} s, gaps of {gap_s:.4g} s")


def table(results: Sequence[Result]) -> list[Row]:
    """Rows over all seeds of a log and rate; only seeds that every estimator has done are used."""
    rows = []
    for log, rate in dict.fromkeys((result.log, result.rate) for result in results):
        here = [result for result in results if (result.log, result.rate) == (log, rate)]
        names = list(dict.fromkeys(result.estimator for result in here))
        seeds = set.intersection(*({(r.case, r.seed) for r in here if r.estimator == name} for name in names))
        for part in SHOWN:
            pooled = {
                name: _pooled([r for r in here if r.estimator == name and (r.case, r.seed) in seeds], part) for name in names
            }
            rows += [_row(log, rate, part, name, pooled) for name in names]
    return rows


Pooled = Mapping[str, Mapping[str, tuple[float, int]]]
"""{metric: {group: (sum, count)}} over seeds."""


def _pooled(results: Sequence[Result], part: str) -> Pooled:
    pooled: dict[str, dict[str, tuple[float, int]]] = {metric: {} for metric in METRICS}
    cases = {result.case for result in results}
    for result in results:
        for metric in METRICS:
            for group, total, count in zip(result.groups, result.sums[part][metric], result.counts[part][metric], strict=True):
                name = f"{result.case}/{group}" if len(cases) == 1 else result.case
                earlier = pooled[metric].get(name, (0.0, 0))
                pooled[metric][name] = (earlier[0] + total, earlier[1] + count)
    return pooled


def _row(log: str, rate: float, part: str, name: str, pooled: Mapping[str, Pooled]) -> Row:
    rng = np.random.default_rng(0)
    means = {}
    for metric, groups in pooled[name].items():
        total, count = (np.array(side, float) for side in zip(*groups.values(), strict=True))
        means[metric] = bootstrap_ratio(total, count, list(groups), rng)
    own = pooled[name]["energy_score_m"]
    num_cells = sum(count for _, count in own.values())
    names = [rival for rival in REFERENCES if rival in pooled]
    if not names:
        return Row(log, rate, part, name, means, num_cells, None, None)
    rivals = {rival: pooled[rival]["energy_score_m"] for rival in names}
    for rival, groups in rivals.items():
        if {group: count for group, (_, count) in groups.items()} != {group: count for group, (_, count) in own.items()}:
            raise CadenceError(f"{log} {rate:g}: {name} and {rival} were scored on different cells; run --again {name} {rival}")
    better = min(rivals, key=lambda rival: sum(total for total, _ in rivals[rival].values()))
    top = [total for total, _ in own.values()]
    bottom = [rivals[better][group][0] for group in own]
    return Row(log, rate, part, name, means, num_cells, bootstrap_ratio(top, bottom, list(own), rng), better)


def tables(rows: Sequence[Row], results: Sequence[Result]) -> dict[str, list[publishing.Row]]:
    """All numbers, and how the windows were cut."""
    numbers = []
    for row in rows:
        means = row.means
        numbers.append({
            "log": row.log, "detections_percent": round(100 * row.rate), "part": row.part, "estimator": row.estimator,
            **publishing.columns("energy_m", means["energy_score_m"]), **publishing.columns("ratio", row.ratio),
            "ratio_to": row.better, **{name: means[name].value for name in ("ade_m", "min_ade_m", "mean_error_m")},
            **{name: means[name].value for name in ("coverage_50", "coverage_90")},
            "trajectory_energy_m": means["trajectory_energy_score_m"].value, "num_cells": row.num_cells,
        })  # fmt: skip
    return {"real_logs": numbers, "real_logs_windows": _windows(results)}


def _windows(results: Sequence[Result]) -> list[publishing.Row]:
    """Step, number of windows and seeds by log and rate; seeds are those that every estimator has done."""
    rows = []
    for log, rate in dict.fromkeys((result.log, result.rate) for result in results):
        here = [result for result in results if (result.log, result.rate) == (log, rate)]
        windows = [result.num_windows for result in here]
        per_estimator = ({r.seed for r in here if r.estimator == name} for name in {r.estimator for r in here})
        rows.append({
            "log": log, "detections_percent": round(100 * rate), "step_s": here[0].step_s, "num_windows_least": min(windows),
            "num_windows_greatest": max(windows), "seeds": " ".join(map(str, sorted(set.intersection(*per_estimator)))),
        })  # fmt: skip
    return rows


def evenly_spread(is_active: Tensor, most_tracks: int) -> Tensor:
    """Windows [b], evenly spread, that hold about `most_tracks` tracks, of those that hold any; all where they are fewer."""
    used = is_active.any(1).nonzero()[:, 0]
    num = max(1, round(most_tracks / max(1.0, float(is_active[used].sum(1).double().mean()))))
    return used[torch.linspace(0, len(used) - 1, min(num, len(used))).round().long()]


def _grouped(
    cells: Cells, windows: MissionWindows, num_windows: int
) -> tuple[list[str], dict[str, dict[str, list[float]]], dict[str, dict[str, list[int]]]]:
    """Names of the bootstrap groups, and sums and counts of every metric by part and group."""
    codes, index = np.unique(groups_of(cells, num_windows), return_inverse=True)
    first = np.array([np.flatnonzero(index == group)[0] for group in range(len(codes))], dtype=np.int64)
    agents = [windows.agent_ids[cells.agent[cell]] for cell in first]
    is_by_agent = len(set(agents)) == len(agents)
    names = agents if is_by_agent else [f"{agent}/{code % 10}" for agent, code in zip(agents, codes, strict=True)]
    sums: dict[str, dict[str, list[float]]] = {}
    counts: dict[str, dict[str, list[int]]] = {}
    for part in PARTS:
        is_in = cells.is_in(part)
        sums[part], counts[part] = {}, {}
        for metric in METRICS:
            value = cells.column(metric)
            valid = is_in & ~np.isnan(value)
            sums[part][metric] = np.bincount(index[valid], value[valid], len(codes)).tolist()
            counts[part][metric] = np.bincount(index[valid], minlength=len(codes)).tolist()
    return names, sums, counts


def _path(work: Path, setting: Setting, name: str, num_hypotheses: int) -> Path:
    return work / setting.folder / f"{name}_k{num_hypotheses}.json"


def _load(work: Path, setting: Setting, name: str, num_hypotheses: int) -> Result | None:
    """An earlier result; None where there is none, or one of another version."""
    try:
        record = json.loads(_path(work, setting, name, num_hypotheses).read_text(encoding="utf-8"))
        is_known = set(record) == {field.name for field in fields(Result)} and record["version"] == RESULT_VERSION
    except (OSError, ValueError, TypeError):
        return None
    return Result(**record) if is_known else None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=WORK, help="results so far (default %(default)s)")
    parser.add_argument("--logs", nargs="+", choices=CASES, default=LOGS)
    parser.add_argument("--rates", nargs="+", type=float, default=list(RATES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--estimators", nargs="+", choices=ESTIMATORS, default=[OWN, *LOG_RIVALS])
    parser.add_argument("--again", nargs="+", choices=ESTIMATORS, default=[], help="do these again though they have results")
    parser.add_argument("--checkpoint", default=DEFAULT, help="of cadence: a file or a shipped name (default %(default)s)")
    parser.add_argument("--hypotheses", type=int, default=30, help="joint samples a window (default %(default)s)")
    parser.add_argument(
        "--most-tracks", type=int, default=100, help="scored of a thinned log, evenly spread (default %(default)s)"
    )
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers, section and picture below this folder")
    parser.add_argument("--as-it-stands", action="store_true", help="run nothing, show and publish the results so far")
    parser.add_argument("--quiet", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(main())
