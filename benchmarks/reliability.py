"""Does what happens as often as answers say happen as often as they say?

Random questions to recorded and simulated tracks of which little was detected: was it in a polygon in a span of time, did two
come near each other, when did it arrive. Every estimator draws stories of the same windows, which see detections up to their
origin, and is asked the same questions about the time between the detections; the truth answers. One JSON file a log, seed and
estimator in the work folder: a killed run goes on where it was.

    python -m benchmarks.reliability --publish docs
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import shapely
import torch
from torch import Tensor

from benchmarks import publishing
from benchmarks.publishing import Measurement
from benchmarks.real_logs import CASES, Setting, prepare
from benchmarks.reliability_page import section, tables
from cadence.answers.areas import Area, Region
from cadence.answers.questions import arrive, inside, meet
from cadence.arrays import Float64s
from cadence.stories import Stories
from cadence.types import Estimator, HypothesisSet
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import Samplings
from pipeline.evaluate.maps import MapScorer
from pipeline.evaluate.rivals import RIVALS
from pipeline.extract.config import ExtractConfig
from pipeline.extract.stage import extract
from pipeline.files import write_atomic
from pipeline.grids import GridConfig, plan_grid
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.progress import Progress
from pipeline.scoring.case import default_truth_gap_s
from pipeline.simulate.stage import SimulateConfig, simulate
from pipeline.tables import read_table
from pipeline.windows import MissionWindows, build_windows, truth_on_grid

WORK = Path("out/benchmarks/reliability")
OWN = "cadence"
ESTIMATORS = (OWN, "bank", "linear", "hold")
RECORDED, SIMULATED = ("ships", "aircraft", "flight"), ("patrol", "prison")
RATE = 0.12
WINDOWS = {"ships": 6, "aircraft": 8, "flight": 12, "patrol": 12, "prison": 6}
"""Windows of a log, evenly spread: fewer where many agents are in each."""
HISTORY_STEPS = 128
_LEAST_S, _MOST_S = 60.0, 1800.0
_AREA_SHARES = (0.01, 0.20)


@dataclass(frozen=True, eq=False)
class Log:
    """Windows of a log, what estimators are fitted to, the truth by agent (seconds since 1970 [N], metres [N, 2]), its gap."""

    windows: MissionWindows
    data: FittingData
    truth: Mapping[str, tuple[Float64s, Float64s]]
    truth_m: Tensor
    is_known: Tensor
    max_gap_s: float
    step_s: float


@dataclass(frozen=True, eq=False)
class Asked:
    """A question to one window: kind inside or meet; agents; from when to when, seconds from the origin; area or distance."""

    window: int
    kind: str
    agents: tuple[int, ...]
    span_s: tuple[float, float]
    area: Area | None
    within_m: float
    truth: tuple[Stories, ...]


@dataclass(frozen=True)
class Told:
    """What an estimator said: probability and whether it was so; interval of arrival and truth, seconds, where both arrive."""

    kind: str
    group: str
    probability: float
    is_so: bool
    arrival_low_s: float | None = None
    arrival_high_s: float | None = None
    arrived_s: float | None = None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the tables, and publish them where asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", nargs="+", default=[*RECORDED, *SIMULATED], choices=[*RECORDED, *SIMULATED])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--estimators", nargs="+", default=list(ESTIMATORS))
    parser.add_argument("--windows", type=int, help=f"of each log, evenly spread; default: {WINDOWS}")
    parser.add_argument("--finer", type=int, default=4, help="steps are so many times as short as those of cadence infer")
    parser.add_argument("--hypotheses", type=int, default=100)
    parser.add_argument("--questions", type=int, default=500, help="for each log and seed")
    parser.add_argument("--work", type=Path, default=WORK)
    parser.add_argument("--publish", type=Path)
    options = parser.parse_args(arguments)
    told: dict[tuple[str, str], list[Told]] = {}
    maps: dict[tuple[str, str], list[tuple[str, float]]] = {}
    for log in options.logs:
        for seed in options.seeds:
            for name, (answers, scores) in run(log, seed, options).items():
                told.setdefault((log, name), []).extend(answers)
                maps.setdefault((log, name), []).extend(scores)
    facts = publishing.facts_of("reliability", arguments) | {
        "num_hypotheses": options.hypotheses,
        "detections_percent": 100 * RATE,
    }
    publishing.publish(Measurement("reliability", facts, tables(told, maps)), section, options.publish)
    return 0


def run(log: str, seed: int, options: argparse.Namespace) -> dict[str, tuple[list[Told], list[tuple[str, float]]]]:
    """What every estimator answered about one log and seed, and its MapScores with their groups."""
    paths = {
        name: options.work / f"{log}_seed{seed}" / f"{name}_{options.hypotheses}_{options.questions}_{options.finer}.json"
        for name in (*options.estimators, "ring")
    }
    if not all(path.is_file() for path in paths.values()):
        _measure(log, seed, options, paths)
    found = {}
    for name, path in paths.items():
        content = json.loads(path.read_text(encoding="utf-8"))
        found[name] = [Told(**row) for row in content["told"]], [(str(group), float(value)) for group, value in content["maps"]]
    return found


def _measure(log: str, seed: int, options: argparse.Namespace, paths: Mapping[str, Path]) -> None:
    known = load(log, seed, options.work / f"{log}_seed{seed}", options.finer)
    used = torch.linspace(0, known.windows.batch.num_windows - 1, options.windows or WINDOWS[log]).round().long().unique()
    asked = list(questions(known, used.tolist(), options.questions, np.random.default_rng([seed, 7])))
    batch = known.windows.batch[used]
    maps = MapScorer.of(batch, known.truth_m[used], known.is_known[used], known.windows.datum_m[used.numpy()])
    for name, path in paths.items():
        if path.is_file():
            continue
        mine = maps.fresh()
        answers: list[Told] = []
        if name == "ring":
            cells = mine.rings()
        else:
            draw = mine.watch(_drawing(name, known, batch, options.hypotheses))
            for row, window in enumerate(used.tolist()):
                drawn = draw(torch.tensor([row]))
                answers += [_told(each, drawn, known, log, seed) for each in asked if each.window == window]
            cells = mine.cells()
        is_between = cells.in_part("between")
        groups = [f"{log}/{seed}/{agent}/{window // 6}" for agent, window in zip(cells.agent, cells.window, strict=True)]
        scores = [(group, value) for group, value, used_ in zip(groups, cells.value.tolist(), is_between, strict=True) if used_]
        write_atomic(path, json.dumps({"told": [asdict(each) for each in answers], "maps": scores}))
        print(f"{log} seed {seed}: {name}, {len(answers)} answers", file=sys.stderr)


def load(log: str, seed: int, directory: Path, finer: int = 4) -> Log:
    """A recorded log thinned to `RATE`, or a simulated one as its sensors saw it."""
    quiet = Progress(quiet=True)
    directory.mkdir(parents=True, exist_ok=True)
    if log in SIMULATED:
        simulate(directory / "logs", SimulateConfig(world=log, seed=100 + seed), quiet)
        (path,) = sorted((directory / "logs").glob("*.mcap"))
        ingest(path, directory, IngestConfig(), quiet)
        extract(directory, ExtractConfig(), quiet)
        step_s, stride = 0.0, 8
    else:
        (case,) = CASES[log]
        prepare(Setting(log, case, RATE, seed), directory, quiet)
        step_s, stride = case.step_s(RATE), case.stride_steps
    detections, _ = read_table(directory / "detections.parquet", "detections")
    table, _ = read_table(directory / "truth.parquet", "truth")
    step_s = (step_s or plan_grid(detections, GridConfig()).step_s) / finer
    grid = plan_grid(detections, GridConfig(step_s, HISTORY_STEPS, stride_steps=finer * stride))
    windows = build_windows(detections, grid, seed)
    max_gap_s = default_truth_gap_s(table, grid.step_s)
    truth_m, is_known = truth_on_grid(table, windows, max_gap_s)
    data = FittingData.of(detections, grid, windows)
    return Log(windows, data, _truth(table), truth_m, is_known, max_gap_s, grid.step_s)


def _truth(table: pa.Table) -> dict[str, tuple[Float64s, Float64s]]:
    found = {}
    names = np.array(table["agent_id"].to_pylist(), dtype=object)
    time_s = table["time_ns"].to_numpy() * 1e-9
    place = np.stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()], axis=1)
    for name in sorted(set(names.tolist())):
        mine = np.flatnonzero((names == name) & np.isfinite(place).all(axis=1))
        mine = mine[np.unique(time_s[mine], return_index=True)[1]]
        found[str(name)] = time_s[mine], place[mine]
    return found


def questions(known: Log, used: Sequence[int], count: int, rng: np.random.Generator) -> Iterator[Asked]:
    """Random questions about the time between detections, a third of them about two agents where there are several.

    Areas are polygons of 1 to 20 % of the box of what was detected of the agent in the window, half as wide again; spans last
    1 to 30 minutes, or what the window has of that; distances are about as large as the two are apart.
    """
    batch = known.windows.batch
    for _ in range(20 * count):
        if count == 0:
            return
        window = int(rng.choice(used))
        seen = batch.detections.is_observed[window]  # [A, N]
        able = torch.nonzero(seen.sum(dim=1) >= 2)[:, 0].tolist()
        if not able:
            continue
        is_pair = len(able) > 1 and rng.random() < 1 / 3
        agents = tuple(int(agent) for agent in rng.choice(able, 2 if is_pair else 1, replace=False))
        spans = [_seen_span(known, window, agent) for agent in agents]
        begin, end = max(span[0] for span in spans), min(span[1] for span in spans)
        longest = min(_MOST_S, end - begin)
        if longest < 2 * known.step_s:
            continue
        length = np.exp(rng.uniform(np.log(min(_LEAST_S, 0.5 * longest)), np.log(longest)))
        start = rng.uniform(begin, end - length)
        span = float(start), float(start + length)
        truth = tuple(_true_story(known, window, agent, span) for agent in agents)
        if any(story is None for story in truth):
            continue
        stories = tuple(story for story in truth if story is not None)
        places = [_seen_m(known, window, agent) for agent in agents]
        if is_pair:
            apart = np.hypot(*(places[0][:, None] - places[1]).reshape(-1, 2).T)
            within = float(np.median(apart) * np.exp(rng.uniform(-1.5, 0.3)))
            yield Asked(window, "meet", agents, span, None, max(within, 1.0), stories)
        else:
            yield Asked(window, "inside", agents, span, _polygon(places[0], rng), 0.0, stories)
        count -= 1


def _seen_span(known: Log, window: int, agent: int) -> tuple[float, float]:
    """First and last detection of an agent in a window, as far as the window's steps reach, seconds from the origin."""
    detections = known.windows.batch.detections
    time_s = detections.time_s[window, agent][detections.is_observed[window, agent]]
    return max(float(time_s.min()), float(known.windows.batch.time_s[0])), float(time_s.max())


def _seen_m(known: Log, window: int, agent: int) -> Float64s:
    detections = known.windows.batch.detections
    place: Float64s = detections.position_m[window, agent][detections.is_observed[window, agent]].numpy()
    return place


def _true_story(known: Log, window: int, agent: int, span: tuple[float, float]) -> Stories | None:
    """The truth as one story over a span, all its samples; None where they are further apart than the truth is known."""
    name = known.windows.agent_ids[agent]
    if name not in known.truth:
        return None
    time_s, place = known.truth[name]
    time_s = time_s - known.windows.origins_ns[window] * 1e-9
    first, last = int(np.searchsorted(time_s, span[0], "right")) - 1, int(np.searchsorted(time_s, span[1]))
    if first < 0 or last >= len(time_s) or (np.diff(time_s[first : last + 1]) > known.max_gap_s).any():
        return None
    part = slice(first, last + 1)
    track = (place[part] - known.windows.datum_m[window])[None, None]
    return Stories(time_s[part], track, np.ones(1), ("truth",)) if last > first else None


def _polygon(place: Float64s, rng: np.random.Generator) -> Region:
    low, high = place.min(axis=0), place.max(axis=0)
    size = np.maximum(high - low, 0.2 * max(float((high - low).max()), 1.0))
    middle, size = 0.5 * (low + high), 1.5 * size
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 7))
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(0.6, 1.0, (7, 1)) * size
    hull = shapely.MultiPoint(ring).convex_hull
    wanted = float(np.prod(size)) * np.exp(rng.uniform(*np.log(_AREA_SHARES)))
    scale = np.sqrt(wanted / hull.area)
    centre = middle + size * rng.uniform(-0.5, 0.5, 2)
    return Region(shapely.affinity.translate(shapely.affinity.scale(hull, scale, scale, origin=(0, 0)), *centre))


def _drawing(name: str, known: Log, batch: object, num_hypotheses: int):
    estimator: Estimator
    if name == OWN:
        estimator = load_estimator("general", Samplings()).fitted(known.data).estimator
    else:
        estimator = RIVALS[name](known.data)

    def draw(index: Tensor) -> HypothesisSet:
        return estimator.sample(batch[index], num_hypotheses)  # type: ignore[index]

    return draw


def _told(asked: Asked, drawn: HypothesisSet, known: Log, log: str, seed: int) -> Told:
    batch = known.windows.batch
    names = known.windows.agent_ids
    position = drawn.position_m[0].double().numpy()
    stories = Stories(
        batch.time_s.double().numpy(), position, drawn.weight[0].double().numpy() / float(drawn.weight[0].sum()), names
    )
    group = f"{log}/{seed}/{asked.agents[0]}/{asked.window // 6}"
    if asked.kind == "meet":
        one, other = asked.agents
        found = meet(stories, one, other, asked.within_m, 0.0, asked.span_s)
        true_one, true_other = asked.truth
        time_s = np.unique(np.concatenate([true_one.time_s, true_other.time_s]))
        tracks = np.concatenate([true_one.at(time_s), true_other.at(time_s)], axis=1)
        both = Stories(time_s, tracks, np.ones(1), ("one", "other"))
        is_so = meet(both, 0, 1, asked.within_m, 0.0, asked.span_s).met.value == 1.0
        return Told("meet", group, found.met.value, is_so)
    assert asked.area is not None
    found_inside = inside(stories, asked.agents[0], asked.area, asked.span_s)
    (truth,) = asked.truth
    true_inside = inside(truth, 0, asked.area, asked.span_s)
    law = arrive(stories, asked.agents[0], asked.area, asked.span_s)
    true_law = arrive(truth, 0, asked.area, asked.span_s)
    has_both = law.arrived_s is not None and law.arrived.value > 0.5 and true_law.arrived_s is not None
    return Told(
        "inside", group, found_inside.ever.value, true_inside.ever.value == 1.0,
        law.arrived_s.low if has_both and law.arrived_s else None, law.arrived_s.high if has_both and law.arrived_s else None,
        true_law.arrived_s.median if has_both and true_law.arrived_s else None,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
