"""Evaluate forecasts by the paper's protocol: random moments of many episodes, thirty hypotheses of the next two hours.

At a moment (episode, step) the detections up to it are known; the 120 positions from it on are asked for (after its end the
target stays where it was) and scored at the steps 0, 29, 59, 89 and 119 (`pipeline.forecast.scores`). The windows are
scored in blocks that are kept, so that a killed call goes on where it was.
"""

import dataclasses
import functools
import hashlib
import itertools
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.settings import AbsoluteSampling, PlaceSampling
from cadence.errors import ConfigError, InputError
from cadence.recordings import ForecastWindows, Recordings, choose_windows, cut_windows
from cadence.types import Detections, Estimator, HypothesisSet, WindowBatch
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.config import config_as_dict
from pipeline.episodes.recordings import RecordingsConfig, RecordingSet, load_recordings
from pipeline.estimators.presets import load_forecaster
from pipeline.estimators.samplings import Samplings
from pipeline.files import hash_file, write_atomic
from pipeline.forecast.rivals import FORECAST_RIVALS, label_of
from pipeline.forecast.scores import HORIZONS, EpisodeScores, score_forecasts
from pipeline.forecast.tables import ForecastFacts, as_csv, as_json, as_markdown, headline, pool
from pipeline.manifest import StageResult, run_stage
from pipeline.progress import Progress
from pipeline.provenance import versions

STAGE = "forecast"
BLOCK = 200
"""Windows that are sampled and scored at once, and kept."""

SCORES_FORMAT = 2
"""Of the kept blocks; since 2 hypotheses at the truth's place are tied with it."""


@dataclass(frozen=True)
class ForecastConfig:
    """How the forecasts of a checkpoint are evaluated on a folder of logs.

    num_windows     random moments of random episodes, every step of every episode equally likely
    num_hypotheses  for each of them
    known_start     the target's first position counts as a detection, as in the paper
    known_goal      a goal that the searching side knows of is told to estimators that read it
    trackers        so are the positions of the trackers
    obstacles       and what is in the way, to estimators that keep out of it
    rivals          out of `pipeline.forecast.rivals.FORECAST_RIVALS`, scored on the same windows
    checkpoints     further ones, scored beside: files or shipped names
    num_resamples   bootstrap resamples of an interval, over episodes
    seed            of the choice of windows, of the hypotheses and of the bootstrap
    recordings      how episodes are read from the logs; the folder of the call is its data
    training        episodes that the rivals learn from; needed by all of them
    paper, place    how checkpoints of these presets are sampled; scene, the older name of place, is still read
    """

    num_windows: int = 2000
    num_hypotheses: int = 30
    known_start: bool = True
    known_goal: bool = True
    trackers: bool = True
    obstacles: bool = True
    rivals: tuple[str, ...] = ()
    checkpoints: tuple[str, ...] = ()
    num_resamples: int = 1000
    seed: int = 0
    recordings: RecordingsConfig = field(default_factory=RecordingsConfig)
    training: RecordingsConfig | None = None
    paper: AbsoluteSampling = field(default_factory=AbsoluteSampling)
    place: PlaceSampling = field(default_factory=PlaceSampling, metadata={"older_name": "scene"})

    def __post_init__(self) -> None:
        unknown = [name for name in self.rivals if name not in FORECAST_RIVALS]
        if unknown:
            raise ValueError(f"rival {unknown[0]!r} is not known; known rivals: {', '.join(FORECAST_RIVALS)}")
        if self.rivals and self.training is None:
            raise ValueError("rivals learn from other episodes: set training, or leave the rivals out")
        if min(self.num_windows, self.num_hypotheses, self.num_resamples) < 1 or self.seed < 0:
            raise ValueError("num_windows, num_hypotheses and num_resamples must be at least 1, seed not negative")


@dataclass(frozen=True)
class _Key:
    """What a result depends on beside the checkpoints' files."""

    forecast: ForecastConfig
    checkpoint: str
    logs: str


def evaluate_forecasts(
    folder: Path, checkpoint: str, out: Path, config: ForecastConfig, progress: Progress, force: bool = False
) -> StageResult:
    """Score a checkpoint's forecasts on the logs in `folder`; writes forecast.json, .csv and .md into `out`.

    Raises `InputError` where no log can be used, `ConfigError` for a checkpoint that is not there or does not forecast.
    """
    names = tuple(dict.fromkeys([checkpoint, *config.checkpoints]))
    samplings = Samplings(paper=config.paper, place=config.place)
    estimators = {label_of(name): load_forecaster(name, samplings) for name in names}
    if len(estimators) < len(names):
        raise ConfigError(f"evaluate.forecast.checkpoints: two of {', '.join(names)} have the same name; rename one")
    source = dataclasses.replace(config.recordings, data=folder)
    logs = sorted(folder.glob(source.pattern)) if folder.is_dir() else []
    digest = hashlib.sha256("".join(f"{log.name} {hash_file(log)}\n" for log in logs).encode()).hexdigest()
    weights = [find_checkpoint(name) for name in names]

    def body(work: Path) -> Mapping[str, Any]:
        # Beside the results, not inside the working folder: what a killed call has done is to be found again.
        cache = out / "cache"
        together = any(map(draws_together, estimators.values()))
        episodes = load_recordings(source, cache, progress, together)
        windows = forecast_windows(episodes.recordings, config)
        run = ForecastRun(episodes, windows, config.num_hypotheses, cache / "scores", progress, config.obstacles)

        @functools.cache
        def training() -> Recordings:
            assert config.training is not None  # refused by the configuration
            return load_recordings(config.training, cache, progress).recordings.apart()

        settings = [config.paper, config.place]
        scores = {
            label: run.score(label, functools.partial(_same, estimators[label]), [checkpoint_hash(path), *settings])
            for label, path in zip(estimators, weights, strict=True)
        }
        for name in config.rivals:
            scores[name] = run.score(name, functools.partial(_fitted, name, training), [name, config.training])
        report = pool(scores, truth_scores(episodes, windows), facts_of(episodes, windows, config), config.num_resamples)
        write_atomic(work / "forecast.json", as_json(report))
        write_atomic(work / "forecast.csv", as_csv(report))
        write_atomic(work / "forecast.md", as_markdown(report))
        counts = {
            "num_episodes": episodes.recordings.num_episodes,
            "num_left_out": len(episodes.left_out),
            "num_windows": len(windows),
        }
        return {**counts, "scores": headline(report)}

    if not logs:
        load_recordings(source, out / "cache", progress)  # says what is wrong
    inputs = [item for path in weights for item in (path, path.with_suffix(".json"))]
    key = _Key(config, ",".join(names), digest)
    return run_stage(STAGE, out, config=key, inputs=inputs, body=body, force=force)


def _same(estimator: Estimator) -> Estimator:
    return estimator


def _fitted(name: str, training: Callable[[], Recordings]) -> Estimator:
    return FORECAST_RIVALS[name](training())


def forecast_windows(recordings: Recordings, config: ForecastConfig) -> ForecastWindows:
    """The windows of an evaluation. `InputError` where nothing is known anywhere."""
    if not (config.known_start or recordings.is_detected.any()):
        raise InputError("no log has a detection, and the start is not known (evaluate.forecast.known_start)")
    rng = np.random.default_rng([config.seed, 20])
    episode, step = choose_windows(recordings, config.num_windows, rng, config.known_start)
    windows = cut_windows(recordings, episode, step, known_start=config.known_start, seed=config.seed)
    context = windows.context
    if not config.known_goal:
        nothing = torch.full((len(windows), 1, 2), torch.nan, dtype=torch.float64)
        context = dataclasses.replace(context, known_goal_m=nothing)
    if not config.trackers and context.tracker_m is not None:
        context = dataclasses.replace(context, tracker_m=torch.full_like(context.tracker_m, torch.nan))
    return windows.with_context(context)


@dataclass(frozen=True, eq=False)
class ForecastRun:
    """Windows of some episodes, and where the scores of their blocks are kept.

    cache  a folder; None: nothing is kept
    tells_obstacles  to estimators that keep out of them
    """

    episodes: RecordingSet
    windows: ForecastWindows
    num_hypotheses: int
    cache: Path | None
    progress: Progress
    tells_obstacles: bool = True

    @functools.cached_property
    def content(self) -> str:
        """Hash of all that is asked and known."""
        windows, context = self.windows, self.windows.context
        values = [*vars(self.episodes.recordings).values(), windows.episode, windows.step, windows.windows.seeds]
        values += [windows.windows.detections.is_observed, context.known_goal_m, context.tracker_m]
        found = hashlib.sha256()
        for value in values:
            found.update(np.ascontiguousarray(value).tobytes())
        texts: dict[int, str] = {}
        for item in self.episodes.obstacles:
            if id(item) not in texts:
                texts[id(item)] = repr([item.circle_array.tolist(), [shape.wkt for shape in item.shapes]])
        found.update(repr([texts[id(item)] for item in self.episodes.obstacles]).encode())
        return found.hexdigest()

    def score(self, label: str, build: Callable[[], Estimator], identity: list[object]) -> EpisodeScores:
        """Scores of an estimator, which is built only where a block is not kept already.

        `identity` is what its answers depend on: names, hashes, configurations.
        """
        plain = [config_as_dict(item) if dataclasses.is_dataclass(item) else item for item in identity]
        asked = [self.num_hypotheses, self.tells_obstacles]
        key = json.dumps([plain, self.content, asked, versions(), SCORES_FORMAT], sort_keys=True, default=str)
        stem = f"{label}-{hashlib.sha256(key.encode()).hexdigest()[:24]}"
        estimator: Estimator | None = None
        parts = []
        with self.progress.bar(len(self.windows), label, unit="window") as bar:
            for begin in range(0, len(self.windows), BLOCK):
                part = self.windows[begin : begin + BLOCK]
                path = None if self.cache is None else self.cache / f"{stem}-{begin:06d}.json"
                found = _kept(path)
                if found is None:
                    estimator = estimator or build()
                    found = self._score_block(estimator, part)
                    if path is not None:
                        write_atomic(path, found.as_json())
                parts.append(found)
                bar.update(len(part))
        return EpisodeScores.add(parts)

    def _score_block(self, estimator: Estimator, part: ForecastWindows) -> EpisodeScores:
        """The windows of episodes with the same obstacles go together."""
        which = [id(self._obstacles(index)) for index in part.episode.tolist()]
        groups = [part[torch.tensor([item == chosen for item in which])] for chosen in dict.fromkeys(which)]
        return EpisodeScores.add([self._score_group(estimator, group) for group in groups])

    def _score_group(self, estimator: Estimator, part: ForecastWindows) -> EpisodeScores:
        obstacles = self._obstacles(int(part.episode[0]))
        alone = part.apart()
        is_known = alone.windows.is_active[:, 0]
        alone = alone[is_known]
        begin = time.process_time()
        asked = part if draws_together(estimator) else alone
        if self.tells_obstacles:
            asked = asked.with_context(dataclasses.replace(asked.context, obstacles=obstacles))
        found = estimator.sample(asked.windows, self.num_hypotheses)
        seconds = time.process_time() - begin
        if draws_together(estimator):
            found = _agent_by_agent(found, is_known)
        num_lost = int((~torch.isfinite(found.position_m)).flatten(1).any(dim=1).sum())
        if num_lost:
            raise ConfigError(
                f"{estimator.name}: no position for {num_lost} of {len(alone)} windows; does it need a known goal "
                "or trackers that the logs do not have? See evaluate.forecast"
            )
        paper = paper_error(estimator, asked.windows, asked.truth_m)
        return score_forecasts(found, alone.truth_m, alone.episode, alone.context.datum_m, obstacles, paper, seconds)

    def _obstacles(self, episode: int) -> Obstacles:
        return self.episodes.obstacles[episode * self.episodes.recordings.num_agents]


def draws_together(estimator: Estimator) -> bool:
    """Whether an estimator draws all agents of a window together, so that it must see them in one."""
    return bool(getattr(estimator, "draws_together", False))


def _agent_by_agent(found: HypothesisSet, is_known: Tensor) -> HypothesisSet:
    """Joint hypotheses [B, K, A, T, 2] as those of single agents [R, K, 1, T, 2], where `is_known` [B * A] holds."""
    size = found.position_m.shape[2]
    position = found.position_m.transpose(1, 2).flatten(0, 1)[is_known, :, None]
    status = itertools.compress(((text,) for row in found.status for text in row), is_known.tolist())
    return HypothesisSet(position, found.weight.repeat_interleave(size, 0)[is_known], tuple(status))


def paper_error(estimator: Estimator, windows: WindowBatch, truth_m: Tensor) -> Tensor | None:
    """The measure sum_k pi_k |mu_k - y| [B, H] of an estimator that answers with mixtures; None for others."""
    mixture = getattr(estimator, "mixture", None)
    if mixture is None:
        return None
    error: Tensor = mixture(windows).expected_distance(truth_m[:, 0, list(HORIZONS)])
    return error


def _kept(path: Path | None) -> EpisodeScores | None:
    """The scores in a file; None where there are none, or none that can be read."""
    if path is None:
        return None
    try:
        return EpisodeScores.from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, LookupError, TypeError):
        return None


def truth_scores(episodes: RecordingSet, windows: ForecastWindows) -> EpisodeScores:
    """The truth scored as if it were a forecast of one hypothesis: how long its steps are, and how often it is in obstacles."""
    return ForecastRun(episodes, windows, 1, None, Progress(quiet=True)).score("truth", lambda: _Truth(windows), [])


@dataclass(frozen=True, eq=False)
class _Truth:
    """Answers with what came, for windows that it finds by their seeds."""

    windows: ForecastWindows
    name: str = "truth"
    draws_together: bool = True

    def fit(self, tracks: Detections) -> "_Truth":
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        seeds, order = self.windows.windows.seeds.sort()
        track = self.windows.truth_m[order[torch.searchsorted(seeds, windows.seeds)]]
        weight = torch.full((len(track), num_hypotheses), 1.0 / num_hypotheses, dtype=torch.float64)
        position = track[:, None].expand(-1, num_hypotheses, -1, -1, -1)
        return HypothesisSet(position, weight, (("ok",) * track.shape[1],) * len(track))


def facts_of(episodes: RecordingSet, windows: ForecastWindows, config: ForecastConfig) -> ForecastFacts:
    """What a reader of the tables must know."""
    return ForecastFacts(
        num_episodes=episodes.recordings.num_episodes,
        num_left_out=len(episodes.left_out),
        left_out=episodes.left_out,
        num_windows=len(windows),
        num_hypotheses=config.num_hypotheses,
        detection_rate=float(episodes.recordings.rates().mean()),
        step_s=episodes.recordings.step_s,
        scale_m=episodes.scale_m,
        known_start=config.known_start,
        known_goal=config.known_goal and bool(np.isfinite(episodes.recordings.known_goal_m).any()),
        seed=config.seed,
    )
