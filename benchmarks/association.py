"""Who tells targets apart, and where were they, where a log does not say which detection came from whom?

Held-out episodes of the world `rendezvous` as one stream of detections, and real ship reports without identity. The association
of this project (its likeliest way, and the mean of its ways, each agent's detections smoothed by the bank) beside two trackers
of Stone Soup: global nearest neighbour and joint probabilistic data association, both with Rauch-Tung-Striebel smoothing. The
trackers' settings are searched by the score that is reported, so in their favour. Everything is retrospective: all detections
of a log are known. One JSON file per log and per search lies in the work folder: a killed run goes on where it was.

    python benchmarks/association.py --publish docs/benchmarks
"""

import argparse
import datetime
import itertools
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from cadence.association.associate import associate
from cadence.association.types import CLUTTER, AssociationConfig, agent_probability
from cadence.bank.bank import Bank
from cadence.metrics import Interval, bootstrap_mean, gospa
from cadence.types import Detections, WindowBatch
from cadence.worlds.rendezvous import RendezvousConfig, simulate_rendezvous_batch

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
WORK = Path("out/benchmarks/association")
SHIPS = "maritime/solent_ais_unknown.mcap"
ORDER = 2.0
NUM_WAYS = 6
HELD_OUT_SEED, TUNING_SEED = 20261, 20262
_EPOCH = datetime.datetime(2026, 1, 1)

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Log:
    """A stream of unknown origin and its truth.

    time_s [N], position_m [N, 2], sigma_m of the detections, origin [N] which agent caused them; truth_m [A, T, 2] at
    grid_s [T], NaN where unknown; num_agents is what every tracker is told, None: nothing; cutoff_m of GOSPA; speed_mps of a
    typical target.
    """

    time_s: Floats
    position_m: Floats
    sigma_m: float
    origin: Integers
    grid_s: Floats
    truth_m: Floats
    num_agents: int | None
    cutoff_m: float
    speed_mps: float


@dataclass(frozen=True, eq=False)
class Estimate:
    """Tracks [A', T, 2] on the grid, NaN where one does not exist; labels [N] and P(detection -> agent), if there are any."""

    position_m: Floats
    label: Integers | None = None
    probability: Floats | None = None


Estimator = Callable[[Log], dict[str, Estimate]]


def rendezvous_logs(seed: int, number: int) -> list[Log]:
    """Episodes of three agents, as one stream each; a grid point every sixth step."""
    episodes = simulate_rendezvous_batch(RendezvousConfig(), seed, range(number))
    logs = []
    for index in range(number):
        track = episodes.track_m(index).astype(np.float64)
        first = int(episodes.recordings.offset[index * episodes.num_agents])
        seen = episodes.recordings.is_detected[first : first + track.shape[0] * track.shape[1]].reshape(track.shape[:2])
        step, agent = np.nonzero(seen.T)
        grid = np.arange(0, track.shape[1], 6)
        logs.append(Log(step * 60.0, track[agent, step], 1.0, agent, grid * 60.0, track[:, grid], len(track), 1000.0, 2.2))
    return logs


def ship_logs() -> list[Log]:
    """The real log, read by the pipeline; truth between reports at most two minutes apart."""
    from pipeline.extract import ExtractConfig, extract
    from pipeline.ingest import IngestConfig, ingest
    from pipeline.progress import Progress
    from pipeline.tables import read_table

    quiet = Progress(quiet=True)
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "ships"
        ingest(DATA / SHIPS, directory, IngestConfig(), quiet)
        extract(directory, ExtractConfig(), quiet)
        detections, _ = read_table(directory / "detections.parquet", "detections")
        truth, _ = read_table(directory / "truth.parquet", "truth")
    start = detections["time_ns"].to_numpy().min()
    when, seen = ((table["time_ns"].to_numpy() - start) * 1e-9 for table in (truth, detections))
    place, position = (np.stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()], 1) for table in (truth, detections))
    agent = np.array(truth["agent_id"].to_pylist())
    grid = np.arange(0.0, seen.max(), 60.0)
    tracks, cause = [], np.full((len(np.unique(agent)), len(seen)), np.inf)
    for row, name in enumerate(np.unique(agent)):
        order = np.flatnonzero(agent == name)[np.argsort(when[agent == name], kind="stable")]
        times, points = when[order], place[order]
        after = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
        is_known = (grid >= times[0]) & (grid <= times[-1]) & (times[after] - times[after - 1] <= 120.0)
        line = np.stack([np.interp(grid, times, points[:, axis]) for axis in (0, 1)], 1)
        tracks.append(np.where(is_known[:, None], line, np.nan))
        nearest = np.clip(np.searchsorted(times, seen - 1e-6), 0, len(times) - 1)
        is_same = np.abs(times[nearest] - seen) < 1e-6
        cause[row, is_same] = np.hypot(*(points[nearest] - position)[is_same].T)
    return [Log(seen, position, 15.0, cause.argmin(0), grid, np.stack(tracks), None, 100.0, 3.0)]


# Ours: ways to read the stream, each agent's detections smoothed by the bank.


def smoothed(log: Log, labels: Integers) -> Floats:
    """The bank's mean tracks [M, A, T, 2] of M labellings [M, N]; the bank is fitted to the first.

    Where the number of agents is not known a track ends at its first and last detection.
    """
    num_agents = max(int(labels.max(initial=CLUTTER)) + 1, log.num_agents or 1)
    rows = [np.flatnonzero(label == agent) for label in labels for agent in range(num_agents)]
    stretches = [row[begin : begin + 16] for row in rows[:num_agents] for begin in range(0, len(row), 16)]
    bank = Bank().fit(_padded(log, [row for row in stretches if len(row) > 1]), float(log.grid_s[1] - log.grid_s[0]))
    batch = WindowBatch(torch.from_numpy(log.grid_s), _padded(log, rows), torch.zeros(len(rows), dtype=torch.int64), 0)
    out = np.full((len(rows), len(log.grid_s), 2), np.nan)
    out[batch.is_active[:, 0].numpy()] = bank.posterior(batch, 1).mean_m.numpy()
    if log.num_agents is None:
        for track, row in zip(out, rows, strict=True):
            if len(row):
                track[(log.grid_s < log.time_s[row[0]]) | (log.grid_s > log.time_s[row[-1]])] = np.nan
    return out.reshape(len(labels), num_agents, len(log.grid_s), 2)


def _padded(log: Log, rows: list[Integers]) -> Detections:
    """Some of the detections a row [R, 1, N]."""
    width = max((len(row) for row in rows), default=1) or 1
    index = np.stack([np.pad(row, (0, width - len(row))) for row in rows])[:, None]
    is_observed = np.stack([np.arange(width) < len(row) for row in rows])[:, None]
    covariance = np.broadcast_to(log.sigma_m**2 * np.eye(2), (*index.shape, 2, 2)).copy()
    return Detections(*(torch.from_numpy(v) for v in (log.time_s[index], log.position_m[index], covariance, is_observed)))


def known(log: Log) -> dict[str, Estimate]:
    """What the bank makes of true origins: the part of the score that is not association."""
    return {"true origins (not a rival)": Estimate(smoothed(log, log.origin[None])[0], log.origin)}


def ours(log: Log) -> dict[str, Estimate]:
    """The likeliest way, and the weighted mean of all ways."""
    covariance = np.broadcast_to(log.sigma_m**2 * np.eye(2), (len(log.time_s), 2, 2))
    config = AssociationConfig(num_agents=log.num_agents, num_ways=NUM_WAYS)
    ways = associate(log.time_s, log.position_m, covariance, log.time_s[-1:], config, seed=0)[0]
    tracks = smoothed(log, ways.label)
    probability = agent_probability(ways)
    return {
        "association, likeliest way": Estimate(tracks[0], ways.label[0], probability),
        "association, mean of ways": Estimate(set_mean(tracks, ways.weight), None, None),
    }


def set_mean(tracks: Floats, weight: Floats) -> Floats:
    """Mean [A, T, 2] of tracks [M, A, T, 2] as sets: at each moment those of every way are matched to the likeliest one's.

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


# Rivals: Stone Soup.


@dataclass(frozen=True)
class Settings:
    """Of a tracker: intensity of the acceleration noise, gate in standard deviations, density of false detections, patience."""

    diffusion: float
    gate: float
    clutter_per_m2: float
    patience_s: float


def stone_soup(kind: str, settings: Settings, log: Log) -> Estimate:
    """Tracks of the GNN or JPDA tracker of Stone Soup, smoothed, at the grid's times (empty scans there make predictions)."""
    from stonesoup.types.detection import Detection
    from stonesoup.types.update import Update

    tracker, smoother, model = _tracker(kind, settings, log)
    numbers: dict[object, int] = {}
    scans: dict[float, set[object]] = {float(moment): set() for moment in log.grid_s}
    for number, (moment, place) in enumerate(zip(log.time_s, log.position_m, strict=True)):
        detection = Detection(place[:, None], timestamp=_stamp(moment), measurement_model=model)
        numbers[detection] = number
        scans.setdefault(float(moment), set()).add(detection)
    tracker.detector = [(_stamp(moment), scans[moment]) for moment in sorted(scans)]
    found = set()
    for _, tracks in tracker:
        found |= tracks
    label = np.full(len(log.time_s), CLUTTER)
    out = []
    order = sorted(found, key=lambda track: (-sum(isinstance(state, Update) for state in track), track[0].timestamp, track.id))
    grid_index = {_stamp(moment): index for index, moment in enumerate(log.grid_s)}
    for track in order[: log.num_agents]:
        updates = [index for index, state in enumerate(track.states) if isinstance(state, Update)]
        for index in updates:
            number = numbers.get(_likeliest_measurement(track.states[index].hypothesis))
            if number is not None:
                label[number] = len(out)
        out.append(_on_grid(smoother.smooth(track), updates, grid_index, log.num_agents is not None))
    return Estimate(np.stack(out) if out else np.full((1, len(log.grid_s), 2), np.nan), label)


def _stamp(moment: float) -> datetime.datetime:
    return _EPOCH + datetime.timedelta(seconds=float(moment))


def _likeliest_measurement(hypothesis: object) -> object:
    """The detection that a hypothesis, or most of a mixture of hypotheses, gives to a track."""
    if hasattr(hypothesis, "single_hypotheses"):
        return max((single for single in hypothesis if single), key=lambda single: float(single.probability)).measurement
    return getattr(hypothesis, "measurement", None)


def _on_grid(track: Sequence, updates: list[int], grid_index: dict[datetime.datetime, int], is_held: bool) -> Floats:
    """Smoothed positions [T, 2] from the first to the last detection; held beyond them where all agents are always there."""
    out = np.full((len(grid_index), 2), np.nan)
    last = updates[-1] if updates else 0
    for state in track[: last + 1]:
        index = grid_index.get(state.timestamp)
        if index is not None:
            out[index] = np.ravel(state.state_vector)[[0, 2]]
    if is_held:
        ends = [np.ravel(track[index].state_vector)[[0, 2]].astype(float) for index in (0, last)]
        stamps = list(grid_index)
        out[[index for index, stamp in enumerate(stamps) if stamp < track[0].timestamp]] = ends[0]
        out[[index for index, stamp in enumerate(stamps) if stamp > track[last].timestamp]] = ends[1]
    return out


def _tracker(kind: str, settings: Settings, log: Log):
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDA
    from stonesoup.deleter.time import UpdateTimeDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import SimpleMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.smoother.kalman import KalmanSmoother
    from stonesoup.tracker.simple import MultiTargetMixtureTracker, MultiTargetTracker
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(settings.diffusion), ConstantVelocity(settings.diffusion)])
    measured = LinearGaussian(4, (0, 2), np.eye(2) * max(log.sigma_m, 1.0) ** 2)
    predictor, updater = KalmanPredictor(motion), KalmanUpdater(measured)
    prior = GaussianState(np.zeros((4, 1)), np.diag([0.0, log.speed_mps**2, 0.0, log.speed_mps**2]), timestamp=_EPOCH)
    if kind == "GNN":
        associator = GNNWith2DAssignment(DistanceHypothesiser(predictor, updater, Mahalanobis(), settings.gate))
        tracker_class = MultiTargetTracker
    else:
        probability = PDAHypothesiser(predictor, updater, settings.clutter_per_m2, 0.11, 1.0 - np.exp(-0.5 * settings.gate**2))
        associator, tracker_class = JPDA(probability), MultiTargetMixtureTracker
    deleter = UpdateTimeDeleter(datetime.timedelta(seconds=settings.patience_s))
    tracker = tracker_class(SimpleMeasurementInitiator(prior, measured), deleter, None, associator, updater)
    return tracker, KalmanSmoother(motion), measured


def searched(kind: str, logs: Sequence[Log], options: Sequence[Settings]) -> Settings:
    """The settings of least mean GOSPA on `logs`."""
    means = [np.mean([scores_of(stone_soup(kind, option, log), log).gospa.mean() for log in logs]) for option in options]
    return options[int(np.argmin(means))]


def rival(kind: str, settings: Settings) -> Estimator:
    """An estimator that runs one tracker of Stone Soup."""
    return lambda log: {f"{kind} + RTS (Stone Soup)": stone_soup(kind, settings, log)}


# Scores.


@dataclass(frozen=True, eq=False)
class Scores:
    """GOSPA [T] and its parts (to the power of the order) [T], labels that are right, links that are right."""

    gospa: Floats
    localisation: Floats
    missed: Floats
    false: Floats
    right: float
    linked: float


def scores_of(estimate: Estimate, log: Log) -> Scores:
    """All scores of one estimate."""
    parts = []
    for index in range(len(log.grid_s)):
        sets = [tracks[:, index][np.isfinite(tracks[:, index, 0])] for tracks in (estimate.position_m, log.truth_m)]
        result = gospa(torch.from_numpy(sets[0]), torch.from_numpy(sets[1]), log.cutoff_m, ORDER)
        parts.append((result.distance, result.localisation, result.missed, result.false))
    right, linked = label_scores(estimate.label, log.origin) if estimate.label is not None else (np.nan, np.nan)
    return Scores(*np.array(parts).T, right, linked)


def label_scores(label: Integers, origin: Integers) -> tuple[float, float]:
    """Share of labels that are right (names matched once a log), and of an agent's successive detections with one label."""
    name = matched(label, origin)
    linked = [(label[rows][1:] == label[rows][:-1]) & (label[rows][1:] >= 0) for rows in _rows_of(origin)]
    return float((name == origin).mean()), float(np.concatenate(linked).mean())


def matched(label: Integers, origin: Integers) -> Integers:
    """Labels renamed to the agents that they overlap most with, one to one; -1 for what matches nobody."""
    table = np.zeros((int(label.max(initial=0)) + 1, int(origin.max()) + 1))
    np.add.at(table, (label[label >= 0], origin[label >= 0]), 1)
    rows, columns = linear_sum_assignment(-table)
    name = np.full(len(table) + 1, CLUTTER)
    name[rows] = columns
    return name[label]


def _rows_of(origin: Integers) -> list[Integers]:
    return [np.flatnonzero(origin == agent) for agent in np.unique(origin)]


def told(probability: Floats, origin: Integers) -> tuple[Floats, NDArray[np.bool_]]:
    """P(detection -> agent) of every detection and agent, flat, and whether it came true; names as they overlap most."""
    table = np.stack([probability[origin == agent, :-1].sum(0) for agent in range(int(origin.max()) + 1)], axis=1)
    pairs = list(zip(*linear_sum_assignment(-table), strict=True))
    said = np.concatenate([probability[:, row] for row, _ in pairs])
    return said, np.concatenate([origin == column for _, column in pairs])


def calibration(said: Floats, came: Floats) -> list[str]:
    """How often what is said comes true, in five bins."""
    lines = []
    for low, high in itertools.pairwise((0.0, 0.1, 0.5, 0.9, 0.99, 1.0 + 1e-9)):
        inside = (said >= low) & (said < high)
        if inside.any():
            means = f"{said[inside].mean():.3f} | {came[inside].mean():.3f}"
            lines.append(f"| {low:g} to {min(high, 1.0):g} | {inside.sum()} | {means} |")
    return lines


@dataclass(frozen=True, eq=False)
class Case:
    """Logs to score, logs to search the trackers' settings on, and which settings."""

    name: str
    logs: list[Log]
    tuning: list[Log]
    options: tuple[Settings, ...]


def rendezvous_case(number: int) -> Case:
    """Held-out episodes; settings are searched on two others."""
    options = [Settings(q, gate, 1e-10, 3600.0) for q in (3e-3, 1e-2, 1e-1) for gate in (4.0, 8.0)]
    return Case("rendezvous", rendezvous_logs(HELD_OUT_SEED, number), rendezvous_logs(TUNING_SEED, 2), tuple(options))


def ships_case() -> Case:
    """The real log; settings are searched on its first quarter."""
    log = ship_logs()[0]
    first = log.time_s < 0.25 * log.time_s[-1]
    grid = log.grid_s < 0.25 * log.time_s[-1]
    quarter = Log(
        log.time_s[first], log.position_m[first], log.sigma_m, log.origin[first], log.grid_s[grid], log.truth_m[:, grid],
        None, log.cutoff_m, log.speed_mps,
    )  # fmt: skip
    options = [Settings(q, 4.0, 1e-8, patience) for q, patience in ((1e-2, 300.0), (1e-1, 300.0), (1e-1, 1200.0))]
    return Case("ships", [log], [quarter], tuple(options))


def searched_for(job: tuple[Path, str, Case]) -> Settings:
    """The settings of one tracker for a case, from the work folder if they are there."""
    file, kind, case = job
    if not file.is_file():
        _keep(file, asdict(searched(kind, case.tuning, case.options)))
    return Settings(**json.loads(file.read_text(encoding="utf-8")))


def estimated(job: tuple[Path, Log, dict[str, Settings]]) -> dict[str, dict]:
    """Scores of every estimator on one log, from the work folder if they are there.

    A further estimator is one more function from a log to named estimates.
    """
    file, log, settings = job
    if not file.is_file():
        estimators: list[Estimator] = [known, ours, *(rival(kind, chosen) for kind, chosen in settings.items())]
        found = {name: estimate for estimator in estimators for name, estimate in estimator(log).items()}
        rows = {name: asdict(scores_of(estimate, log)) for name, estimate in found.items()}
        for name, estimate in found.items():
            if estimate.probability is not None:
                rows[name]["said"], rows[name]["came"] = told(estimate.probability, log.origin)
        _keep(file, {name: {key: np.asarray(value).tolist() for key, value in row.items()} for name, row in rows.items()})
    return json.loads(file.read_text(encoding="utf-8"))


def _keep(file: Path, value: object) -> None:
    from pipeline.manifest import write_atomic

    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(file, json.dumps(value))


def table(case: Case, jobs: int) -> list[str]:
    """The section of one case."""
    folder = WORK / case.name
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        settings = dict(zip(KINDS, pool.map(searched_for, [(folder / f"{k}.json", k, case) for k in KINDS]), strict=True))
        work = [(folder / f"log{index}.json", log, settings) for index, log in enumerate(case.logs)]
        results = list(pool.map(estimated, work))
    lines = [ROW_HEAD]
    for name in results[0]:
        rows = [{key: np.array(value, dtype=float) for key, value in result[name].items()} for result in results]
        interval = _interval([row["gospa"] for row in rows])
        cells = [f"{interval.value:.1f} ({interval.low:.1f} to {interval.high:.1f})"]
        cells += [f"{np.mean([np.sqrt(row[part].mean()) for row in rows]):.0f}" for part in PARTS]
        shares = [100.0 * np.mean([row[key] for row in rows]) for key in ("right", "linked")]
        cells += ["-" if np.isnan(share) else f"{share:.1f}" for share in shares]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    chosen = "; ".join(f"{kind}: {setting}" for kind, setting in settings.items())
    rows = [row for result in results for row in result.values() if "said" in row]
    said, came = (np.concatenate([np.array(row[key], dtype=float) for row in rows]) for key in ("said", "came"))
    lines += ["", f"Settings that the search chose: {chosen}.", "", CALIBRATION_HEAD]
    return lines + calibration(said, came)


def _interval(gospas: Sequence[Floats]) -> Interval:
    """Mean GOSPA and its interval: over episodes, or over blocks of ten minutes where there is one log only."""
    values = np.concatenate(gospas)
    log = np.repeat(np.arange(len(gospas)), [len(gospa_m) for gospa_m in gospas])
    groups = log if len(gospas) > 1 else np.arange(len(values)) // 10
    return bootstrap_mean(values, groups, np.random.default_rng(0))


PARTS = ("localisation", "missed", "false")
KINDS = ("GNN", "JPDA")
ROW_HEAD = """| estimator | GOSPA, m (95 %) | localisation | missed | false | labels right, % | links right, % |
|---|---|---|---|---|---|---|"""
CALIBRATION_HEAD = """| P(detection -> agent) said | cases | mean said | came true |
|---|---|---|---|"""


def main() -> int:
    """The tables, printed and published."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--without-ships", action="store_true", help="leave out the recorded ships, which take longest")
    parser.add_argument("--publish", type=Path, help="folder for association.md")
    arguments = parser.parse_args()
    from pipeline.manifest import write_atomic
    from pipeline.provenance import versions

    text = HEAD.format(
        seed=HELD_OUT_SEED, episodes=arguments.episodes, versions=", ".join(f"{n} {v}" for n, v in versions().items())
    )
    text += "\n".join(table(rendezvous_case(arguments.episodes), arguments.jobs)) + "\n"
    if (DATA / SHIPS).is_file() and not arguments.without_ships:
        text += SHIPS_HEAD + "\n".join(table(ships_case(), arguments.jobs)) + "\n"
    sys.stdout.write(text)
    if arguments.publish is not None:
        write_atomic(arguments.publish / "association.md", text)
    return 0


HEAD = """# Who tells targets apart where a log does not say which detection came from whom?

    python benchmarks/association.py

One stream of detections without identity, all of it known (retrospective). *Association* is this project's: ways to read the
stream by a particle filter, the detections that a way gives to an agent smoothed by the bank; the likeliest way, and the mean
of the ways as sets (matched at every moment to the likeliest). *GNN* and *JPDA* are Stone Soup's trackers (constant velocity)
with its Rauch-Tung-Striebel smoother; their settings are searched by the score of this table on other episodes (ships: on the
first quarter of the same log), so in their favour. *True origins* is the bank given the truth's labels: what is left is not
association.

GOSPA with order p = 2 and alpha = 2, mean over time, metres; its parts as root mean square, metres. Intervals: bootstrap over
episodes (ships: over blocks of ten minutes of the one log). Labels right: names matched one to one once a log. Links right: two
successive detections of a target have one label.

Versions: {versions}.

## Rendezvous: three targets that meet, wait and leave together, or do not

{episodes} episodes of seed {seed}; 10 to 12 % of the steps of each target detected, exact positions. The number of targets is
told to all: of the trackers' tracks the three with most detections count, held still before their first and after their last
detection. Cut-off c = 1000 m.

"""
SHIPS_HEAD = """
## Ships: 12 real tracks, reports without identity

12 % of the reports, 15 m noise; the number of ships is told to nobody. A track exists from its first to its last detection.
Cut-off c = 100 m.

"""


if __name__ == "__main__":
    sys.exit(main())
