"""Who tells targets apart, and where were they, where a log does not say which detection came from whom?

Held-out episodes of the world `rendezvous` as one stream of detections, and real ship reports without identity. The association
of this project (one hypothesis, and the mean of several, each agent's detections smoothed by the bank) beside two trackers of
Stone Soup: global nearest neighbour and joint probabilistic data association, both with Rauch-Tung-Striebel smoothing. Their
settings are searched on other episodes, or on a part of the log that is not scored. All of these know all detections of a log;
on the ships `cadence run` stands beside them, of which each moment is read from a window that ends two to four minutes later.
Files in the work folder keep what was done: a killed run goes on where it was.

    python -m benchmarks.association --publish docs
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from benchmarks import publishing
from benchmarks.association_logs import SHIPS, Estimate, Log, rendezvous_logs, ship_log
from benchmarks.association_scores import calibration, scores_of, told
from benchmarks.association_trackers import KINDS, NUM_SAMPLES, Settings, searched, tracked
from benchmarks.publishing import Measurement
from cadence.arrays import Float64s, Int64s
from cadence.association.associate import associate
from cadence.association.types import CLUTTER, AssociationConfig, agent_probability
from cadence.bank.bank import Bank
from cadence.metrics import Interval, bootstrap_mean
from cadence.types import Detections, WindowBatch
from pipeline.files import write_atomic

WORK = Path("out/benchmarks/association")
NUM_ASSOCIATIONS = 12
"""Association hypotheses whose tracks are averaged."""
LAG_S = 120.0
HELD_OUT_SEED, TUNING_SEED = 20263, 20262
MOTIONS = ((1e-4, 0.0), (1e-3, 0.0), (1e-2, 0.0), (1e-1, 0.0), (3e-3, 3e-4), (1e-2, 1e-3), (3e-2, 3e-3), (1e-1, 1e-2))
"""Intensity and damping where the search of a tracker's settings begins; the damped ones have about 2 m/s in the long run."""
NUM_TUNING = 8
"""Episodes on which the trackers' settings are searched."""

Estimator = Callable[[Log], dict[str, Estimate]]


def smoothed(log: Log, labels: Int64s, num_samples: int) -> tuple[Float64s, Float64s]:
    """The bank's mean tracks [M, A, T, 2] of M labellings [M, N], and samples [K, A, T, 2] of the first, to which it is fitted.

    Where the number of agents is not known a track ends at its first and last detection.
    """
    num_agents = max(int(labels.max(initial=CLUTTER)) + 1, log.num_agents or 1)
    rows = [np.flatnonzero(label == agent) for label in labels for agent in range(num_agents)]
    stretches = [row[begin : begin + 16] for row in rows[:num_agents] for begin in range(0, len(row), 16)]
    bank = Bank().fit(_padded(log, [row for row in stretches if len(row) > 1]), float(log.grid_s[1] - log.grid_s[0]))
    batch = WindowBatch(torch.from_numpy(log.grid_s), _padded(log, rows), torch.arange(len(rows)), 0)
    mean, sample = (
        np.full((len(rows), len(log.grid_s), 2), np.nan),
        np.full((num_agents, num_samples, len(log.grid_s), 2), np.nan),
    )
    is_active = batch.is_active[:, 0].numpy()
    mean[is_active] = bank.posterior(batch, 1).mean_m.numpy()
    sample[is_active[:num_agents]] = bank.posterior(batch[torch.arange(num_agents)], num_samples).sample_m.numpy()
    if log.num_agents is None:
        for track, row in zip(mean, rows, strict=True):
            if len(row):
                track[(log.grid_s < log.time_s[row[0]]) | (log.grid_s > log.time_s[row[-1]])] = np.nan
    return mean.reshape(len(labels), num_agents, len(log.grid_s), 2), sample.swapaxes(0, 1)


def _padded(log: Log, rows: list[Int64s]) -> Detections:
    """Some of the detections a row [R, 1, N]."""
    width = max((len(row) for row in rows), default=1) or 1
    index = np.stack([np.pad(row, (0, width - len(row))) for row in rows])[:, None]
    is_observed = np.stack([np.arange(width) < len(row) for row in rows])[:, None]
    covariance = np.broadcast_to(log.sigma_m**2 * np.eye(2), (*index.shape, 2, 2)).copy()
    return Detections(*(torch.from_numpy(v) for v in (log.time_s[index], log.position_m[index], covariance, is_observed)))


def known(log: Log) -> dict[str, Estimate]:
    """What the bank makes of true origins: the part of the score that is not association."""
    mean, sample = smoothed(log, log.origin[None], NUM_SAMPLES)
    return {"true origins (not a rival)": Estimate(mean[0], log.origin, None, sample)}


def ours(log: Log) -> dict[str, Estimate]:
    """The association that agrees most with all, and the weighted mean of several."""
    covariance = np.broadcast_to(log.sigma_m**2 * np.eye(2), (len(log.time_s), 2, 2))
    config = AssociationConfig(num_agents=log.num_agents)
    found = associate(log.time_s, log.position_m, covariance, log.time_s[-1:], config, seed=0)[0]
    mean, sample = smoothed(log, found.label[:NUM_ASSOCIATIONS], NUM_SAMPLES)
    weight = found.weight[:NUM_ASSOCIATIONS] / found.weight[:NUM_ASSOCIATIONS].sum()
    return {
        "association, one hypothesis": Estimate(mean[0], found.label[0], agent_probability(found), sample),
        "association, mean of hypotheses": Estimate(set_mean(mean, weight)),
    }


def set_mean(tracks: Float64s, weight: Float64s) -> Float64s:
    """Mean [A, T, 2] of tracks [M, A, T, 2] as sets: at each moment those of every association are matched to the first one's.

    A mean by name would put agents half-way between two places wherever two associations exchange them; GOSPA knows no names.
    """
    out = tracks[0].copy()
    for step in range(out.shape[1]):
        total = np.where(np.isfinite(out[:, step, 0]), weight[0], 0.0)
        place = np.nan_to_num(out[:, step]) * weight[0]
        for number in range(1, len(tracks)):
            distance = np.linalg.norm(tracks[0, :, None, step] - tracks[number, None, :, step], axis=-1)
            rows, columns = linear_sum_assignment(np.nan_to_num(distance, nan=1e12))
            is_pair = np.isfinite(distance[rows, columns])
            place[rows[is_pair]] += weight[number] * tracks[number, columns[is_pair], step]
            total[rows[is_pair]] += weight[number]
        is_there = total > 0
        out[is_there, step] = place[is_there] / total[is_there, None]
    return out


def recorded(log: Log) -> dict[str, Estimate]:
    """What `cadence run` says of the ships with the general checkpoint: each moment as in the first window `LAG_S` later.

    Labels are those of the last window; tracks are means and hypotheses by name.
    """
    from pipeline.results import read_hypothesis_tables
    from pipeline.tables import read_table

    directory = WORK / "ships/run_general" / SHIPS.stem
    settings = ["--set", "infer.checkpoint=general", "--set", "infer.grid.stride_steps=32"]
    command = [sys.executable, "-c", "import sys, cli; sys.exit(cli.main())", "run", str(SHIPS), "--out", str(directory.parent)]
    subprocess.run([*command, "--quiet", *settings], check=True, stdout=subprocess.DEVNULL)
    stored = read_hypothesis_tables(directory)
    detections, _ = read_table(directory / "detections.parquet", "detections")
    labels, _ = read_table(directory / "labels.parquet", "labels")
    start_ns = int(detections["time_ns"].to_numpy().min())
    number = {name: index for index, name in enumerate(stored.agent_ids)}
    origins_s = np.array([(window.origin_ns - start_ns) * 1e-9 for window in stored.windows])
    num_samples = len(stored.windows[0].weight)
    sample = np.full((num_samples, len(number), len(log.grid_s), 2), np.nan)
    for index, moment in enumerate(log.grid_s):
        window = stored.windows[min(int(np.searchsorted(origins_s, moment + LAG_S)), len(origins_s) - 1)]
        place = (moment * 1e9 + start_ns - window.start_ns) / window.step_ns
        before = int(np.clip(place, 0, window.num_steps - 2))
        share = place - before
        for agent in window.agents:
            if agent.is_live:
                ends = agent.position_m[:, before : before + 2].astype(np.float64)
                sample[:, number[agent.agent_id], index] = (
                    (1.0 - share) * ends[:, 0] + share * ends[:, 1] + np.array(agent.datum_m)
                )
    label = np.full(len(log.time_s), CLUTTER)
    is_last = labels["window"].to_numpy() == len(stored.windows) - 1
    names = [CLUTTER if name is None else number[name] for name in labels["agent_id"].to_pylist()]
    label[labels["detection"].to_numpy()[is_last]] = np.array(names)[is_last]
    is_there = np.isfinite(sample[..., 0]).mean(0) >= 0.5
    mean = np.where(is_there[..., None], np.nanmean(sample, axis=0), np.nan)
    return {"cadence run, general": Estimate(mean, label, None, np.where(np.isfinite(sample), sample, mean))}


@dataclass(frozen=True, eq=False)
class Case:
    """Logs to score, logs to search the trackers' settings on, and where the search begins."""

    name: str
    logs: list[Log]
    tuning: list[Log]
    starts: tuple[Settings, ...]


def rendezvous_case(number: int) -> Case:
    """Held-out episodes; settings are searched on others."""
    starts = tuple(Settings(q, damping, 4.0, 3600.0, 1e-10, 0.4) for q, damping in MOTIONS)
    return Case("rendezvous", rendezvous_logs(HELD_OUT_SEED, number), rendezvous_logs(TUNING_SEED, NUM_TUNING), starts)


def ships_case() -> Case:
    """The real log; settings are searched on the part that is not scored."""
    log = ship_log()
    tuning = replace(log.until(log.scored_from_s), scored_from_s=0.0)
    starts = tuple(Settings(q, damping, 4.0, 300.0, 1e-8, 0.1) for q, damping in MOTIONS)
    return Case("ships", [log], [tuning], starts)


def searched_for(job: tuple[str, Case]) -> Settings:
    """The settings of one tracker for a case."""
    kind, case = job
    return searched(kind, case.tuning, case.starts, WORK / case.name / "search")


def estimated(job: tuple[Path, Log, Estimator]) -> dict[str, dict]:
    """Scores of one estimator on one log, from the work folder if they are there."""
    file, log, estimator = job
    if not file.is_file():
        rows = {}
        for name, estimate in estimator(log).items():
            rows[name] = asdict(scores_of(estimate, log))
            if estimate.probability is not None:
                rows[name]["said"], rows[name]["came"] = told(estimate.probability, log.origin)
        file.parent.mkdir(parents=True, exist_ok=True)
        plain = {name: {key: np.asarray(value).tolist() for key, value in row.items()} for name, row in rows.items()}
        write_atomic(file, json.dumps(plain))
    return json.loads(file.read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Rival:
    """An estimator that runs one tracker of Stone Soup."""

    kind: str
    settings: Settings

    def __call__(self, log: Log) -> dict[str, Estimate]:
        """The tracker's estimate."""
        return {f"{self.kind} + RTS (Stone Soup)": tracked(self.kind, self.settings, log)}


def tables(case: Case, jobs: int, further: dict[str, Estimator]) -> dict[str, list[publishing.Row]]:
    """All numbers of one case, with further estimators by the folder of their scores."""
    folder = WORK / case.name
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        settings = dict(zip(KINDS, pool.map(searched_for, [(kind, case) for kind in KINDS]), strict=True))
        estimators: dict[str, Estimator] = {"known": known, "ours": ours}
        estimators |= further
        estimators |= {f"{kind}_{chosen.label}": Rival(kind, chosen) for kind, chosen in settings.items()}
        work = [
            (folder / name / f"log{index}.json", log, one)
            for name, one in estimators.items()
            for index, log in enumerate(case.logs)
        ]
        found = list(pool.map(estimated, work))
    results: dict[str, list[dict]] = {}
    for rows in found:
        for name, row in rows.items():
            results.setdefault(name, []).append({key: np.array(value, dtype=float) for key, value in row.items()})
    with_tracks = [rows for rows in results.values() if all(np.isfinite(row["energy"]).any() for row in rows)]
    common = [np.all([np.isfinite(rows[index]["energy"]) for rows in with_tracks], axis=0) for index in range(len(case.logs))]
    told_of = [row for rows in results.values() for row in rows if "said" in row]
    said, came = (np.concatenate([row[key] for row in told_of]) for key in ("said", "came"))
    of = {"case": case.name}
    cells_percent = 100.0 * np.mean([cells.mean() for cells in common])
    facts = {"num_logs": len(case.logs), "cutoff_m": case.logs[0].cutoff_m, "energy_cells_percent": cells_percent}
    return {
        "association": [{**of, "estimator": name, **_scores(rows, common)} for name, rows in results.items()],
        "association_told": [{**of, **row} for row in calibration(said, came)],
        "association_settings": [{**of, "tracker": kind, **asdict(chosen)} for kind, chosen in settings.items()],
        "association_cases": [{**of, **facts}],
    }


def _scores(rows: list[dict], common: list[np.ndarray]) -> publishing.Row:
    """One estimator's scores over all logs: GOSPA and its parts (root mean square over time), OSPA, labels, energy score."""
    parts = {
        f"{name}_m": np.mean([np.sqrt(row["distances"][:, part].mean()) for row in rows])
        for part, name in enumerate(("localisation", "missed", "false"), start=1)
    }
    shares = {
        f"{name}_percent": 100.0 * np.mean([row[key] for row in rows])
        for name, key in (("labels", "right"), ("links", "linked"))
    }
    energy = np.concatenate([row["energy"][is_common] for row, is_common in zip(rows, common, strict=True)])
    return {
        **publishing.columns("gospa_m", _interval([row["distances"][:, 0] for row in rows])), **parts,
        "ospa_m": np.mean([row["distances"][:, 4].mean() for row in rows]), **shares, "energy_m": energy.mean(),
    }  # fmt: skip


def _interval(gospas: Sequence[Float64s]) -> Interval:
    """Mean GOSPA and its interval: over episodes, or over blocks of ten minutes where there is one log only."""
    values = np.concatenate(gospas)
    log = np.repeat(np.arange(len(gospas)), [len(gospa_m) for gospa_m in gospas])
    groups = log if len(gospas) > 1 else np.arange(len(values)) // 10
    return bootstrap_mean(values, groups, np.random.default_rng(0))


LIKELY = 0.5
"""Shown is how often attributions come true that are at least so probable; all are in the table."""


def section(measured: Measurement) -> str:
    """Both cases, and how often what is said of a detection comes true."""
    cases = measured.rows("cases")
    lines = []
    for estimator in dict.fromkeys(row["estimator"] for row in measured.rows()):
        line = [estimator]
        for case in cases:
            rows = measured.rows(case=case["case"], estimator=estimator)
            labels = rows[0]["labels_percent"] if rows else None
            line += [
                publishing.interval(rows[0], "gospa_m", ".0f") if rows else "–",
                "–" if labels is None else f"{labels:.0f}",
            ]
        lines.append(line)
    logs = [f"{case['case']} ({case['num_logs']} {'log' if case['num_logs'] == 1 else 'logs'})" for case in cases]
    scores = publishing.table(["GOSPA, m; labels, %", *(head for log in logs for head in (log, "labels"))], lines)
    names = [case["case"] for case in cases]
    bins = dict.fromkeys((row["said_from"], row["said_to"]) for row in measured.rows("told") if row["said_from"] >= LIKELY)
    lines = []
    for low, high in bins:
        found = [measured.rows("told", case=name, said_from=low, said_to=high) for name in names]
        cells = [f"{rows[0]['came_true']:.2f} of {rows[0]['num_cases']}" if rows else "–" for rows in found]
        lines.append([f"{low:g} to {high:g}", *cells])
    heads = ["said: P(detection → agent)", *(f"{name}: came true" for name in names)]
    return f"{scores}\n\n{publishing.table(heads, lines)}"


def main() -> int:
    """Measure, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--without-ships", action="store_true", help="leave out the recorded ships, which take longest")
    parser.add_argument("--without-run", action="store_true", help="leave out `cadence run` on the ships")
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    found = tables(rendezvous_case(arguments.episodes), arguments.jobs, {})
    if SHIPS.is_file() and not arguments.without_ships:
        further: dict[str, Estimator] = {} if arguments.without_run else {"run": recorded}
        for name, rows in tables(ships_case(), arguments.jobs, further).items():
            found[name] += rows
    facts = publishing.facts_of("association") | {"seed": HELD_OUT_SEED, "num_associations": NUM_ASSOCIATIONS}
    publishing.publish(Measurement("association", facts, found), section, arguments.publish)
    return 0


if __name__ == "__main__":
    sys.exit(main())
