"""Who tells targets apart, and where were they, where a log does not say which detection came from whom?

Held-out episodes of the world `rendezvous` as one stream of detections, and real ship reports without identity. The association
of this project (one way, and the mean of several, each agent's detections smoothed by the bank) beside two trackers of Stone
Soup: global nearest neighbour and joint probabilistic data association, both with Rauch-Tung-Striebel smoothing. The trackers'
settings are searched on other episodes, or on a part of the log that is not scored. All of these know all detections of a log;
on the ships `cadence run` stands beside them, of which each moment is read from a window that ends two to four minutes later.
Files in the work folder keep what was done: a killed run goes on where it was.

    python benchmarks/association.py --publish docs/benchmarks
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
from association_logs import SHIPS, Estimate, Log, rendezvous_logs, ship_log
from association_scores import calibration, scores_of, told
from association_trackers import KINDS, NUM_SAMPLES, Settings, searched, tracked
from scipy.optimize import linear_sum_assignment

from cadence.arrays import Float64s, Int64s
from cadence.association.associate import associate
from cadence.association.types import CLUTTER, AssociationConfig, agent_probability
from cadence.bank.bank import Bank
from cadence.metrics import Interval, bootstrap_mean
from cadence.types import Detections, WindowBatch
from pipeline.files import write_atomic

WORK = Path("out/benchmarks/association")
NUM_WAYS = 12
"""Ways whose tracks are averaged."""
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
    """The way that agrees most with all, and the weighted mean of several."""
    covariance = np.broadcast_to(log.sigma_m**2 * np.eye(2), (len(log.time_s), 2, 2))
    config = AssociationConfig(num_agents=log.num_agents)
    ways = associate(log.time_s, log.position_m, covariance, log.time_s[-1:], config, seed=0)[0]
    mean, sample = smoothed(log, ways.label[:NUM_WAYS], NUM_SAMPLES)
    weight = ways.weight[:NUM_WAYS] / ways.weight[:NUM_WAYS].sum()
    return {
        "association, one way": Estimate(mean[0], ways.label[0], agent_probability(ways), sample),
        "association, mean of ways": Estimate(set_mean(mean, weight)),
    }


def set_mean(tracks: Float64s, weight: Float64s) -> Float64s:
    """Mean [A, T, 2] of tracks [M, A, T, 2] as sets: at each moment those of every way are matched to the first one's.

    A mean by name would put agents half-way between two places wherever two ways exchange them; GOSPA knows no names.
    """
    out = tracks[0].copy()
    for step in range(out.shape[1]):
        total = np.where(np.isfinite(out[:, step, 0]), weight[0], 0.0)
        place = np.nan_to_num(out[:, step]) * weight[0]
        for way in range(1, len(tracks)):
            distance = np.linalg.norm(tracks[0, :, None, step] - tracks[way, None, :, step], axis=-1)
            rows, columns = linear_sum_assignment(np.nan_to_num(distance, nan=1e12))
            is_pair = np.isfinite(distance[rows, columns])
            place[rows[is_pair]] += weight[way] * tracks[way, columns[is_pair], step]
            total[rows[is_pair]] += weight[way]
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


def table(case: Case, jobs: int, further: dict[str, Estimator]) -> list[str]:
    """The section of one case, with further estimators by the folder of their scores."""
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
    lines = [ROW_HEAD, *(_row(name, rows, common) for name, rows in results.items())]
    chosen = "; ".join(f"{kind}: {setting}" for kind, setting in settings.items())
    share = 100.0 * np.mean([cells.mean() for cells in common])
    told_of = [row for rows in results.values() for row in rows if "said" in row]
    said, came = (np.concatenate([row[key] for row in told_of]) for key in ("said", "came"))
    lines += ["", f"Settings that the search chose: {chosen}. Energy scores are over {share:.0f} % of all cells.", ""]
    return [*lines, CALIBRATION_HEAD, *calibration(said, came)]


def _row(name: str, rows: list[dict], common: list[np.ndarray]) -> str:
    """One estimator's line."""
    interval = _interval([row["distances"][:, 0] for row in rows])
    cells = [f"{interval.value:.1f} ({interval.low:.1f} to {interval.high:.1f})"]
    cells += [f"{np.mean([np.sqrt(row['distances'][:, part].mean()) for row in rows]):.0f}" for part in (1, 2, 3)]
    cells.append(f"{np.mean([row['distances'][:, 4].mean() for row in rows]):.1f}")
    shares = [100.0 * np.mean([row[key] for row in rows]) for key in ("right", "linked")]
    cells += ["-" if np.isnan(share) else f"{share:.1f}" for share in shares]
    energy = np.concatenate([row["energy"][is_common] for row, is_common in zip(rows, common, strict=True)])
    cells.append(f"{energy.mean():.1f}" if np.isfinite(energy).all() else "-")
    return f"| {name} | " + " | ".join(cells) + " |"


def _interval(gospas: Sequence[Float64s]) -> Interval:
    """Mean GOSPA and its interval: over episodes, or over blocks of ten minutes where there is one log only."""
    values = np.concatenate(gospas)
    log = np.repeat(np.arange(len(gospas)), [len(gospa_m) for gospa_m in gospas])
    groups = log if len(gospas) > 1 else np.arange(len(values)) // 10
    return bootstrap_mean(values, groups, np.random.default_rng(0))


ROW_HEAD = """| estimator | GOSPA, m (95 %) | localisation | missed | false | OSPA, m | labels, % | links, % | energy, m |
|---|---|---|---|---|---|---|---|---|"""
CALIBRATION_HEAD = """| P(detection -> agent) said | cases | mean said | came true |
|---|---|---|---|"""


def main() -> int:
    """The tables, printed and published."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--without-ships", action="store_true", help="leave out the recorded ships, which take longest")
    parser.add_argument("--without-run", action="store_true", help="leave out `cadence run` on the ships")
    parser.add_argument("--publish", type=Path, help="folder for association.md")
    arguments = parser.parse_args()
    from pipeline.provenance import versions

    text = HEAD.format(
        num_ways=NUM_WAYS,
        flags=" --without-run" * arguments.without_run,
        seed=HELD_OUT_SEED,
        episodes=arguments.episodes,
        versions=", ".join(f"{n} {v}" for n, v in versions().items()),
    )
    text += "\n".join(table(rendezvous_case(arguments.episodes), arguments.jobs, {})) + "\n"
    further: dict[str, Estimator] = {} if arguments.without_run else {"run": recorded}
    if SHIPS.is_file() and not arguments.without_ships:
        text += SHIPS_HEAD + RUN_HEAD * len(further) + "\n".join(table(ships_case(), arguments.jobs, further)) + "\n"
    sys.stdout.write(text)
    if arguments.publish is not None:
        write_atomic(arguments.publish / "association.md", text)
    return 0


HEAD = """# Who tells targets apart where a log does not say which detection came from whom?

    python benchmarks/association.py{flags}

One stream of detections without identity, all of it known (retrospective). *Association* is this project's: ways to read the
stream by a particle filter, the detections that a way gives to an agent smoothed by the bank; the way that agrees most with
all, and the mean of {num_ways} ways as sets (matched at every moment to the first). *GNN* and *JPDA* are Stone Soup's trackers
(constant velocity) with its Rauch-Tung-Striebel smoother; noise, gate and patience are searched by GOSPA on four other episodes
(ships: on the first quarter of the log, which is not scored), one after the other, each as far as it gets better. *True
origins* is the bank given the truth's labels: what is left is not association. The rule for the way that stands first was
settled with these 20 episodes in view; nothing else of ours was.

GOSPA with order p = 2 and alpha = 2, mean over time, metres; its parts as root mean square, metres; OSPA with the same order
and cut-off. Labels: those that are right, names matched one to one once a log. Links: two successive detections of a target
that have one label.
Energy: energy score of the track that GOSPA assigns to a target, over the targets and moments to which every estimator assigns
one, so that it says nothing of targets that were missed. Intervals: bootstrap over episodes (ships: over blocks of ten minutes
of the one log).

Versions: {versions}.

## Rendezvous: three targets that meet, wait and leave together, or do not

{episodes} episodes of seed {seed}; 10 to 12 % of the steps of each target detected, exact positions. The number of targets is
told to all: of the trackers' tracks the three with most detections count, held still before their first and after their last
detection. Cut-off c = 1000 m.

"""
SHIPS_HEAD = """
## Ships: 12 real tracks, reports without identity

12 % of the reports, 15 m noise; the number of ships is told to nobody. A track exists from its first to its last detection.
Two ships lie within 20 m of each other at one berth from the 5th to the 41st minute, and five to seven have another one within
300 m most of the time: much of who is who cannot be known, and what is said of it should be as unsure as that.
Cut-off c = 100 m. The rows of this project are the bank alone. Its association was developed on other episodes of rendezvous
and with a look at the first half of this log, of which a part is scored.

"""
RUN_HEAD = """*cadence run* is the pipeline with the general checkpoint, end to end, with half as many windows as by default:
each moment is read from the first window whose origin lies at least two minutes later (at most four), so that this row knows
less than the others; labels are those of the last window.

"""


if __name__ == "__main__":
    sys.exit(main())
