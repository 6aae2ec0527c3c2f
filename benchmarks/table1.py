"""The paper's table I again: who forecasts best, on our five sets of simulated episodes and on recorded ones?

Evaluation episodes with a seed of their own (fifty a set unless --episodes says more), 2000 random windows, 30 hypotheses,
errors at 0/30/60/90/120 min over the map side (`pipeline.forecast`). Learned methods are checkpoints that are found by name in
--checkpoints (below); what is not found is named in table1.json and left out. Scores are kept in blocks of windows under
--work: a killed run goes on.

A checkpoint is NAME.safetensors or NAME/checkpoint.safetensors; of the names METHOD-WORLD-SET-sN, METHOD-WORLD-SET,
METHOD-WORLD-sN and METHOD-WORLD the first that is found counts, for every training seed N. METHOD is vrnn, grammi_without_mi,
grammi, paper or cadence, WORLD is prison, narco or reference (which takes those of prison where it has none of its own), SET is
low, med or high.

    python -m benchmarks.table1 --publish docs
    python -m benchmarks.table1 --reference ../shared/data/prison_reference --publish docs

The paper's preset takes some 20 times as long to sample as CADENCE; --methods leaves it out, and `table1_paper` compares it
alone.
"""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import publishing
from benchmarks.leads import averaged
from benchmarks.publishing import Measurement
from benchmarks.table1_page import MIXTURES, NAMES, Evaluated, Found, section, tables
from cadence.diffusion.settings import AbsoluteSampling, PlaceSampling
from cadence.errors import CadenceError, InputError
from cadence.recordings import Recordings
from cadence.types import Estimator
from pipeline.checkpoints import checkpoint_hash, find_checkpoint, read_info, windows_seen
from pipeline.config import config_as_dict
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.estimators.presets import load_forecaster
from pipeline.estimators.samplings import Samplings
from pipeline.forecast.rivals import FORECAST_RIVALS
from pipeline.forecast.stage import ForecastConfig, ForecastRun, forecast_windows, truth_scores
from pipeline.progress import Progress

EVALUATION_SEED, TRAINING_SEED = 2_000, 0
LEARNED = (*MIXTURES, "paper", "cadence")
UNTRAINED = ("cv", "particle", "library")


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


def world_cases(num_episodes: int, num_training: int, num_everything: int) -> Iterator[Case]:
    """Our five sets."""
    for world, sets in (("prison", ("low", "med", "high")), ("narco", ("low", "high"))):
        for name in sets:
            of = functools.partial(RecordingsConfig, world=world, set=name)
            training = of(seed=TRAINING_SEED, num_episodes=num_training)
            everything = of(seed=TRAINING_SEED, num_episodes=num_everything)
            yield Case(world, name, of(seed=EVALUATION_SEED, num_episodes=num_episodes), (training,), (everything,))


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
    methods: tuple[str, ...]
    work: Path
    config: ForecastConfig
    progress: Progress


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
        for name in setup.methods:
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
    return Evaluated(rows, episodes.scale_m, len(recordings), rate, episodes.left_out)


def _joined(sources: Sequence[RecordingsConfig], cache: Path, progress: Progress) -> Recordings:
    return Recordings.concatenate([load_recordings(source, cache, progress).recordings for source in sources])


def _rival(name: str, sources: Sequence[RecordingsConfig], training: Callable[..., Recordings]) -> Estimator:
    return FORECAST_RIVALS[name](training(tuple(sources)))


def _learned(name: str, case: Case, paths: Sequence[Path], run: ForecastRun, setup: Setup, goal: bool) -> Found | None:
    """Scores of all trainings of a method; None without any, or where it is not for windows with or without a known goal."""
    parts, budgets = [], []
    samplings = Samplings(paper=setup.config.paper, place=setup.config.place)
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
    seconds = training.get("cpu_seconds")
    hours = None if seconds is None else seconds / 3600.0
    return {"steps": training.get("steps"), "num_windows": windows_seen(training), "cpu_hours": hours}


def arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoints", type=Path, default=Path(__file__).parent / "checkpoints")
    parser.add_argument("--work", type=Path, default=Path("runs/table1"))
    parser.add_argument("--reference", type=Path, help="folder of recorded logs: low, med, high")
    parser.add_argument("--extra", type=Path, help="npz of more recorded episodes of the set low, for the library")
    parser.add_argument("--sets", nargs="*", help='only these, as in "prison low"')
    parser.add_argument("--methods", nargs="*", choices=LEARNED, default=LEARNED, help="of the learned ones; by default all")
    parser.add_argument("--windows", type=int, default=2000)
    parser.add_argument("--episodes", type=int, default=50, help="to evaluate on, of each of our sets")
    parser.add_argument("--hypotheses", type=int, default=30)
    parser.add_argument("--training-episodes", type=int, default=300, help="of each set, for the library and the filters")
    parser.add_argument("--all-episodes", type=int, default=2000, help='of each set, for "library, all episodes"')
    parser.add_argument("--paper-sampler", choices=("ddim", "dpmpp", "ddpm"), default="ddim", help="10 steps; ddpm: 100")
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="float32", help="of CADENCE's network")
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("-q", "--quiet", action="store_true")
    return parser.parse_args()


def main(name: str = "table1", section: Callable[[Measurement], str] = section) -> int:
    """Evaluate, print and publish."""
    args = arguments()
    sampling = AbsoluteSampling(sampler=args.paper_sampler, inpainting="overwrite")
    place = PlaceSampling(precision=args.precision)
    config = ForecastConfig(args.windows, args.hypotheses, rivals=(), paper=sampling, place=place)
    setup = Setup(args.checkpoints, tuple(args.methods), args.work, config, Progress(args.quiet))
    cases = list(world_cases(args.episodes, args.training_episodes, args.all_episodes))
    if args.reference is not None:
        cases += reference_cases(args.reference, args.extra)
    cases = [case for case in cases if not args.sets or case.name in args.sets]
    evaluated, missing = {}, []
    for case in cases:
        setup.progress.note(case.name)
        evaluated[case.name] = evaluate_case(case, setup, missing)
    facts = publishing.facts_of(name) | {
        "num_windows": args.windows, "num_hypotheses": args.hypotheses, "not_found": missing,
        "left_out": {key: found.left_out for key, found in evaluated.items()},
    }  # fmt: skip
    publishing.publish(Measurement(name, facts, tables(name, evaluated, config.seed)), section, args.publish)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CadenceError as error:
        sys.exit(f"{error}")
