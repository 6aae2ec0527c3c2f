"""The paper's table I again: who forecasts best, on our five sets of simulated episodes and on recorded ones?

Fifty evaluation episodes a set with a seed of their own, 2000 random windows, 30 hypotheses, errors at 0/30/60/90/120 min over
the map side (`pipeline.forecasts`). Learned methods are checkpoints that are found by name in --checkpoints (below); what is
not found is named on the page and left out. Scores are kept in blocks of windows under --work: a killed run goes on.

A checkpoint is NAME.safetensors or NAME/checkpoint.safetensors; of the names METHOD-WORLD-SET-sN, METHOD-WORLD-SET,
METHOD-WORLD-sN and METHOD-WORLD the first that is found counts, for every training seed N. METHOD is vrnn, grammi_without_mi,
grammi, paper or cadence, WORLD is prison, narco or reference (which takes those of prison where it has none of its own), SET is
low, med or high.

    python benchmarks/table1.py --publish docs/benchmarks
    python benchmarks/table1.py --reference ../shared/data/prison_reference --publish docs/benchmarks
"""

import argparse
import dataclasses
import functools
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cadence.diffusion.absolute import AbsoluteSampling
from cadence.diffusion.scene import SceneSampling
from cadence.errors import CadenceError, InputError
from cadence.worlds.recordings import Recordings
from pipeline.checkpoints import checkpoint_hash, find_checkpoint, read_info, windows_seen
from pipeline.config import config_as_dict
from pipeline.forecast_leads import averaged, count, relative_lead, verdicts
from pipeline.forecast_scores import HORIZONS, MEASURES, SHARES, EpisodeScores
from pipeline.forecast_tables import TITLES, line, mean_interval, number, with_interval
from pipeline.forecasters import FORECAST_RIVALS, Samplings, load_forecaster
from pipeline.forecasts import ForecastConfig, ForecastRun, forecast_windows, truth_scores
from pipeline.manifest import write_atomic
from pipeline.placed_draws import Forecaster
from pipeline.progress import Progress
from pipeline.recordings import RecordingsConfig, load_recordings

EVALUATION_SEED, TRAINING_SEED = 2_000, 0
MINUTES = ("0", "30", "60", "90", "120 min")
LATE = HORIZONS[2:]
MIXTURES = ("vrnn", "grammi_without_mi", "grammi")
LEARNED = (*MIXTURES, "paper", "cadence")
UNTRAINED = ("cv", "particle", "library")
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
class Case:
    """One set of episodes: its world and name, where evaluation and training episodes come from, and all training episodes."""

    world: str
    set: str
    episodes: RecordingsConfig
    training: tuple[RecordingsConfig, ...]
    everything: tuple[RecordingsConfig, ...]

    @property
    def name(self) -> str:
        """As in the page."""
        return f"{self.world} {self.set}"


@dataclass(frozen=True)
class Found:
    """A method on a set: its scores averaged over trainings, the number of these, and their budgets."""

    scores: EpisodeScores
    num_trainings: int
    budgets: tuple[dict[str, Any], ...] = ()


Results = Mapping[str, Mapping[str, Found]]
"""By the name of the set and of the row: a method, with " +goal" where the known hideout is told."""


def world_cases(num_training: int, num_everything: int) -> Iterator[Case]:
    """Our five sets."""
    for world, sets in (("prison", ("low", "med", "high")), ("narco", ("low", "high"))):
        for name in sets:
            of = functools.partial(RecordingsConfig, world=world, set=name)
            training = of(seed=TRAINING_SEED, num_episodes=num_training)
            everything = of(seed=TRAINING_SEED, num_episodes=num_everything)
            yield Case(world, name, of(seed=EVALUATION_SEED, num_episodes=50), (training,), (everything,))


def reference_cases(folder: Path, extra: Path | None) -> Iterator[Case]:
    """The recorded sets: seeds 0 ... 249 to learn from, 250 ... 299 to evaluate on; `extra` is more of the set low."""
    for name in ("low", "med", "high"):
        data = folder / name
        if not data.is_dir():
            raise InputError(f"{data}: not a folder; --reference is the folder of the sets low, med and high")
        of = functools.partial(RecordingsConfig, data=data)
        training = (of(pattern="**/*_0[01][0-9][0-9].mcap"), of(pattern="**/*_02[0-4][0-9].mcap"))
        more = (RecordingsConfig(data=extra),) if extra is not None and name == "low" else ()
        yield Case("reference", name, of(pattern="**/*_02[5-9][0-9].mcap"), training, training + more)


@dataclass(frozen=True)
class Setup:
    """What the command line says."""

    checkpoints: Path
    work: Path
    config: ForecastConfig
    progress: Progress


@dataclass(frozen=True)
class Evaluated:
    """The rows of a set, what distances are divided by, and what a reader must know of its episodes."""

    rows: dict[str, Found]
    scale_m: float
    num_episodes: int
    num_windows: int
    detection_rate: float
    left_out: tuple[str, ...]


def evaluate_case(case: Case, setup: Setup, missing: list[str]) -> Evaluated:
    """All rows of a set; methods without checkpoint are named in `missing`."""
    cache = setup.work / "recordings"
    episodes = load_recordings(case.episodes, cache, setup.progress)
    training = functools.cache(lambda sources: _joined(sources, cache, setup.progress))
    has_goal = bool(np.isfinite(episodes.recordings.known_goal_m).any())
    rows: dict[str, Found] = {}
    for goal in (False, True) if has_goal else (False,):
        config = dataclasses.replace(setup.config, known_goal=goal)
        windows = forecast_windows(episodes.recordings, config)
        run = ForecastRun(episodes, windows, config.num_hypotheses, setup.work / "scores", setup.progress, config.obstacles)
        suffix = " +goal" if goal else ""
        for name in (*UNTRAINED, "library_all"):
            if goal and not name.startswith("library"):
                continue
            sources = case.everything if name.endswith("_all") else case.training
            if name == "library_all" and case.everything == case.training:
                continue
            build = functools.partial(_rival, name.removesuffix("_all"), sources, training)
            label = f"{name}-{case.world}-{case.set}"
            rows[name + suffix] = Found(run.score(label, build, [name, [config_as_dict(source) for source in sources]]), 1)
        for name in LEARNED:
            paths = trainings(name, case, setup.checkpoints)
            found = _learned(name, case, paths, run, setup, goal)
            if found is not None:
                rows[name + suffix] = found
            elif not paths and not goal:
                missing.append(f"{NAMES[name]} on {case.name} ({candidates(name, case, 0)[0]}.safetensors)")
        if not goal:
            rows["truth"] = Found(truth_scores(episodes, windows), 0)
    recordings = episodes.recordings
    rate = float(recordings.rates().mean())
    if episodes.scale_m is None:
        raise InputError(f"{case.name}: no log states the map's side (Metadata record mission, cell_m or map_side_m)")
    return Evaluated(rows, episodes.scale_m, len(recordings), setup.config.num_windows, rate, episodes.left_out)


def _joined(sources: Sequence[RecordingsConfig], cache: Path, progress: Progress) -> Recordings:
    return Recordings.concatenate([load_recordings(source, cache, progress).recordings for source in sources])


def _rival(name: str, sources: Sequence[RecordingsConfig], training: Callable[..., Recordings]) -> Forecaster:
    return FORECAST_RIVALS[name](training(tuple(sources)))


def _learned(name: str, case: Case, paths: Sequence[Path], run: ForecastRun, setup: Setup, goal: bool) -> Found | None:
    """Scores of all trainings of a method; None without any, or where it is not for windows with or without a known goal."""
    parts, budgets = [], []
    samplings = Samplings(setup.config.paper, setup.config.scene)
    for path in paths:
        info = read_info(path)
        is_reader = reads_goal(info.network)
        is_bound = name == "paper" and is_reader and not info.network.get("optional_goal", False)
        if (goal and not is_reader) or (not goal and is_bound):
            return None
        label = f"{name}-{case.world}-{case.set}"
        build = functools.partial(load_forecaster, str(path), samplings)
        parts.append(run.score(label, build, [name, checkpoint_hash(path), samplings]))
        budgets.append({"checkpoint": path.stem if path.stem != "checkpoint" else path.parent.name, **budget(info.training)})
    return Found(averaged(parts), len(parts), tuple(budgets)) if parts else None


def reads_goal(network: Mapping[str, Any]) -> bool:
    """Whether a checkpoint's network has an input for a known goal."""
    for key, value in network.items():
        if isinstance(value, Mapping) and reads_goal(value):
            return True
        if "goal" in key and value is True:
            return True
    return False


def trainings(name: str, case: Case, folder: Path) -> list[Path]:
    """The checkpoints of a method for a set, one a training seed."""
    found: list[Path] = []
    for seed in range(10):
        for stem in candidates(name, case, seed):
            places = (folder / f"{stem}.safetensors", folder / stem / "checkpoint.safetensors")
            path = next((place for place in places if place.is_file()), None)
            if path is not None:
                if path not in found:
                    found.append(path)
                break
    if not found and name == "cadence":
        try:
            found.append(find_checkpoint("narco" if case.world == "narco" else "prison"))
        except CadenceError:
            return []
    return found


def candidates(name: str, case: Case, seed: int) -> list[str]:
    """Names under which a checkpoint may lie, the most special one first."""
    worlds = (case.world, "prison") if case.world == "reference" else (case.world,)
    ends = (f"-{case.set}-s{seed}", f"-{case.set}", f"-s{seed}", "")
    return [f"{name}-{world}{end}" for world in worlds for end in ends]


def budget(training: Mapping[str, Any]) -> dict[str, Any]:
    """Steps, windows seen and processor time of a training, as far as its checkpoint says."""
    seconds = next((training[key] for key in ("cpu_seconds", "cpu_s", "seconds") if key in training), None)
    hours = None if seconds is None else seconds / 3600.0
    return {"steps": training.get("steps"), "windows": windows_seen(training), "cpu_hours": hours}


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
        worst = {key: [_worst(words) for words in zip(*(found[key] for found in cells), strict=True)] for key in own}
        total = count(worst)
        rows.append({
            "against": duel.title, "sets": list(own), "lead": [lead.value, lead.low, lead.high],
            "lead_from_60_min": [late.value, late.low, late.high], "won": total.won, "tied": total.tied, "lost": total.lost,
            "cells": worst,
        })  # fmt: skip
    return rows


def _worst(words: Sequence[str]) -> str:
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
        unit = 1.0 if measure.startswith("coverage") else scale_m
        for key, found in rows.items():
            if key != "truth":
                cells = [with_interval(*(value / unit for value in triple)) for triple in triples(found.scores, measure, seed)]
                lines.append(line([label(key, found), *cells]))
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


def arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoints", type=Path, default=Path(__file__).parent / "checkpoints")
    parser.add_argument("--work", type=Path, default=Path("runs/table1"))
    parser.add_argument("--reference", type=Path, help="folder of recorded logs: low, med, high")
    parser.add_argument("--extra", type=Path, help="npz of more recorded episodes of the set low, for the library")
    parser.add_argument("--sets", nargs="*", help='only these, as in "prison low"')
    parser.add_argument("--windows", type=int, default=2000)
    parser.add_argument("--hypotheses", type=int, default=30)
    parser.add_argument("--training-episodes", type=int, default=300, help="of each set, for the library and the filters")
    parser.add_argument("--all-episodes", type=int, default=2000, help='of each set, for "library, all episodes"')
    parser.add_argument("--paper-sampler", choices=("ddpm", "ddim", "dpmpp"), default="ddpm")
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="float32", help="of CADENCE's network")
    parser.add_argument("--publish", type=Path, help="folder for table1.md and table1.json")
    parser.add_argument("-q", "--quiet", action="store_true")
    return parser.parse_args()


def main() -> int:
    """Evaluate, print and publish."""
    args = arguments()
    sampling = AbsoluteSampling(sampler=args.paper_sampler, inpainting="overwrite")
    scene = SceneSampling(precision=args.precision)
    config = ForecastConfig(args.windows, args.hypotheses, rivals=(), paper=sampling, scene=scene)
    setup = Setup(args.checkpoints, args.work, config, Progress(args.quiet))
    cases = list(world_cases(args.training_episodes, args.all_episodes))
    if args.reference is not None:
        cases += reference_cases(args.reference, args.extra)
    cases = [case for case in cases if not args.sets or case.name in args.sets]
    evaluated, missing = {}, []
    for case in cases:
        setup.progress.note(case.name)
        evaluated[case.name] = evaluate_case(case, setup, missing)
    shown = [word for word in sys.argv[1:] if word not in ("-q", "--quiet")]
    text = page(evaluated, missing, " ".join(["python benchmarks/table1.py", *shown]), config)
    sys.stdout.write(text)
    if args.publish is not None:
        sets = {name: as_record(found, config.seed) for name, found in evaluated.items()}
        rows = summary_rows({name: found.rows for name, found in evaluated.items()}, config.seed)
        record = {"horizons": HORIZONS, "printed": PRINTED, "sets": sets, "leads": rows, "not_found": missing}
        write_atomic(args.publish / "table1.json", json.dumps(record, indent=1) + "\n")
        write_atomic(args.publish / "table1.md", text)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CadenceError as error:
        sys.exit(f"{error}")
