"""Infer: detections → hypotheses: the model fitted to the log, all windows batched, constraints kept."""

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadence.association.counts import stream_counts
from cadence.association.types import AssociationConfig
from cadence.constraints.obstacles import Obstacles
from cadence.errors import ImplausibleInputError
from cadence.evidence.estimator import WithEvidence
from cadence.types import Evidence
from pipeline.associations import AssociatedWindows, Sources, build_associated_windows, tell_sources
from pipeline.catalogue import read_catalogue
from pipeline.checkpoints import DEFAULT, checkpoint_hash, read_info
from pipeline.counted import counted
from pipeline.estimators.fit_test import FitTest, fit_test
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.loaded import Loaded
from pipeline.estimators.presets import find_weights, load_estimator, refuse_unread
from pipeline.infer.config import InferConfig
from pipeline.infer.draws import Drawn, Piece, draw_associations, draw_tracks, draw_windows
from pipeline.infer.rows import hypothesis_rows, window_rows, with_association, with_effective
from pipeline.manifest import StageResult, run_stage
from pipeline.missions import CATALOGUE_NAME, no_mission
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacles
from pipeline.progress import Progress
from pipeline.stream_words import stream_words
from pipeline.suspicions import Suspicions
from pipeline.tables import Frame, read_table, write_table
from pipeline.threads import in_order, num_cores, one_thread
from pipeline.windows import MissionWindows, build_windows

_MANY_NAMELESS = 2000
_FIRST_S, _LONG_S = 5.0, 120.0
"""After how long one knows what is ahead, and from when on somebody who waits wants to have been told."""


def infer(
    directory: Path, config: InferConfig, progress: Progress, force: bool = False, num_threads: int | None = None
) -> StageResult:
    """Draw hypotheses for every window of the mission in `directory`: hypotheses.parquet and windows.parquet.

    Where detections of unknown origin were told apart, associations.parquet and labels.parquet hold how. A checkpoint that the
    log shows not to fit is not used but suspected; `ImplausibleInputError` where `config.is_strict`. Windows are drawn in
    `num_threads` threads, by default one a core; their number changes no byte.
    """
    weights = find_weights(config.checkpoint)
    inputs = [directory / "detections.parquet", directory / OBSTACLES_NAME]
    if weights is not None:
        read_info(weights)  # names what is wrong with it more plainly than an input that is missing
        inputs += [weights, weights.with_suffix(".json")]
    refuse_unread(config.checkpoint, config)
    if not inputs[0].is_file() and not (directory / CATALOGUE_NAME).is_file():
        raise no_mission(directory)
    detections, frame = read_table(inputs[0], "detections")
    start_ns = _mission_start_ns(directory, detections)

    def body(folder: Path) -> dict[str, Any]:
        if config.is_associated and detections["agent_id"].null_count > _MANY_NAMELESS:
            progress.note(
                f"infer: {detections['agent_id'].null_count} detections do not say whose they are and are told apart one after "
                'the other, which takes a while; agent = "NAME" in [[extract.detections]] means one target, --start and --end '
                "take a part"
            )
        plan = _Plan.of(config, detections, Beside(start_ns, read_obstacles(inputs[1])))
        for line in plan.suspicions.lines():
            progress.note(f"infer: suspected {line}")
        drawn = in_order(plan.draws, num_threads or num_cores())
        summary = _draw(plan, drawn, str(detections["log_id"][0]), folder, frame, progress)
        if plan.seen.sources.association is not None:
            found = plan.seen.sources.association.rows(detections)
            write_table(found, folder / "associations.parquet", "associations", frame)
            labels = plan.seen.sources.association.labels(plan.seen.sources.grid)
            write_table(labels, folder / "labels.parquet", "labels", frame)
        return {
            **summary,
            "step_s": plan.seen.sources.grid.step_s,
            "remarks": [*plan.seen.sources.grid.remarks, *plan.found],
            "context_steps": plan.seen.sources.grid.context_steps,
            "checkpoint": plan.checkpoint,
            "checkpoint_sha256": _hash(plan.checkpoint),
            "seed": config.seed,
            **plan.about,
            "suspicions": plan.suspicions.records(),
        }

    # the catalogue itself is no input: it names the place of the log, and a log that was moved is not inferred again
    facts = {"start_ns": start_ns}
    with one_thread():
        return run_stage("infer", directory, config=config, inputs=inputs, body=body, force=force, facts=facts)


def _hash(checkpoint: str) -> str | None:
    weights = find_weights(checkpoint)
    return None if weights is None else checkpoint_hash(weights)


def _mission_start_ns(directory: Path, detections: pa.Table) -> int:
    """When the log begins; without a catalogue the first detection."""
    if (directory / CATALOGUE_NAME).is_file():
        return read_catalogue(directory).start_ns
    return int(pc.min(detections["time_ns"]).as_py() or 0)


def _draw(plan: "_Plan", draws: Iterable[Drawn], log_id: str, folder: Path, frame: Frame, progress: Progress) -> dict[str, Any]:
    """All windows into the two tables; what the summary says of them."""
    parts, statuses = [], []
    num_windows, begun_s, is_told, num_done = plan.windows.batch.num_windows, time.monotonic(), False, 0
    with progress.bar(num_windows, "infer", unit="window") as bar:
        for part, drawn in draws:
            parts.append(hypothesis_rows(log_id, plan.windows, plan.seen.sources.grid, part, drawn))
            rows = window_rows(plan.windows, part, drawn, plan.max_speed_mps)
            rows = rows if plan.seen.associated is None else with_association(rows, plan.seen.associated, part)
            statuses.append(with_effective(rows, drawn) if plan.has_evidence else rows)
            bar.update(len(part))
            num_done, taken_s = num_done + len(part), time.monotonic() - begun_s
            if not is_told and taken_s > _FIRST_S:
                is_told = True
                _tell_cost(num_windows, num_windows * taken_s / num_done, progress)
    tracks, windows = pa.concat_tables(parts), pa.concat_tables(statuses)
    write_table(tracks, folder / "hypotheses.parquet", "hypotheses", frame)
    write_table(windows, folder / "windows.parquet", "windows", frame)
    counts = windows["status"].value_counts().to_pylist()
    return {
        "num_windows": num_windows,
        "num_agents": pc.count_distinct(tracks["agent_id"]).as_py(),
        "num_tracks": tracks.num_rows,
        "status": {str(item["values"]): int(item["counts"]) for item in counts},
    }


def _tell_cost(num_windows: int, seconds: float, progress: Progress) -> None:
    """What is ahead, by what the first windows took, where one might wish to have fewer."""
    if seconds > _LONG_S:
        progress.note(
            f"infer: {counted(num_windows, 'window')}, about {seconds / 60.0:.0f} min by the first ones; "
            "a larger infer.grid.stride_steps takes fewer"
        )


@dataclass(frozen=True, eq=False)
class Beside:
    """What is known of a mission beside its detections: when it began, its obstacles, what else speaks about tracks."""

    start_ns: int
    obstacles: Obstacles
    evidence: tuple[Evidence, ...] = ()


@dataclass(frozen=True, eq=False)
class _Seen:
    """The windows, by name; `associated` where they have several association hypotheses."""

    sources: Sources
    named: MissionWindows
    associated: AssociatedWindows | None

    @staticmethod
    def of(config: InferConfig, detections: pa.Table, loaded: Loaded) -> "_Seen":
        """The windows of a log on the grid that the model takes."""
        sigma_m, association = config.default_sigma_m, config.association if config.is_associated else None
        grid = loaded.grid(config.grid)
        sources = tell_sources(detections, grid, association, config.seed, sigma_m, config.guidance.max_speed_mps)
        named = build_windows(sources.named, sources.grid, config.seed, sigma_m)
        if sources.association is None:
            return _Seen(sources, named, None)
        associated = build_associated_windows(detections, sources, config.seed, config.num_hypotheses, sigma_m)
        return _Seen(sources, named, associated)

    def about(self, config: AssociationConfig) -> dict[str, Any]:
        """What the summary says of detections of unknown origin; empty where there are none."""
        association = self.sources.association
        if association is None:
            return {}
        at_origins = association.at_origins
        time_s = association.stream.time_ns[: at_origins[-1].num_detections].astype(np.float64) * 1e-9
        return {
            "association": {
                "num_detections": len(association.stream),
                "num_agents": len(association.agent_ids),
                "mean_num_associations": sum(one.num_associations for one in at_origins) / len(at_origins),
                "counts": asdict(stream_counts(at_origins[-1], time_s)),
                "stated": [name for name in ("num_agents", "clutter_share") if getattr(config, name) is not None],
            }
        }


@dataclass(frozen=True, eq=False)
class _Plan:
    """What is to be drawn: the windows, the draws as they come, and what the summary says of the model."""

    checkpoint: str
    seen: _Seen
    draws: Iterator[Piece]
    about: Mapping[str, Any]
    suspicions: Suspicions
    max_speed_mps: float | None
    has_evidence: bool

    @property
    def found(self) -> list[str]:
        """What a stream without identity turned out to be, in words."""
        words = stream_words(self.about.get("association", {}))
        return [words] if words else []

    @staticmethod
    def of(config: InferConfig, detections: pa.Table, beside: Beside) -> "_Plan":
        """The draws of a log by the checkpoint, which decides the grid as well, or by the default one where it does not fit."""
        loaded = load_estimator(config.checkpoint, config.samplings)
        seen = _Seen.of(config, detections, loaded)
        data = FittingData.of(seen.sources.named, seen.sources.grid, seen.named, config.default_sigma_m)
        suspicions, about = Suspicions(), seen.about(config.association)
        if config.is_tested and loaded.fit is None:
            test = fit_test(loaded.estimator, data, seen.named.located(beside.start_ns, beside.obstacles))
            if test is not None and test.is_misfit:
                _suspect(test, config, suspicions)
                plan = _Plan.of(replace(config, checkpoint=DEFAULT), detections, beside)
                return replace(plan, suspicions=suspicions, about={**plan.about, "fit_test": asdict(test)})
            about["fit_test"] = None if test is None else asdict(test)
        fitted = loaded.fitted(data)
        num, evidence = config.num_hypotheses, beside.evidence if config.evidence.is_used else ()
        if seen.associated is None:
            weighed = WithEvidence(fitted.estimator, config.evidence, loaded.is_apart, loaded.num_past)
            located = seen.named.located(beside.start_ns, beside.obstacles, evidence)
            draws = draw_windows(weighed, located, num, loaded.is_apart)
        else:
            associated = seen.associated.located(beside.start_ns, beside.obstacles, evidence)
            draw = draw_tracks if loaded.is_apart else draw_associations
            draws = draw(fitted.estimator, associated, num, config.evidence)
        about = {**fitted.about, **about}
        return _Plan(config.checkpoint, seen, draws, about, suspicions, config.guidance.max_speed_mps, bool(evidence))

    @property
    def windows(self) -> MissionWindows:
        """What the tables speak of."""
        return self.seen.named if self.seen.associated is None else self.seen.associated.windows


def _suspect(test: FitTest, config: InferConfig, suspicions: Suspicions) -> None:
    """Say that the checkpoint is of another place; `ImplausibleInputError` where that is to be refused."""
    suspicions.add(
        "checkpoint", config.checkpoint, seen=f"it does not fit this log: {test}",
        done=f"hypotheses are drawn with {DEFAULT!r} instead", setting="infer.is_tested = false",
    )  # fmt: skip
    if config.is_strict:
        raise ImplausibleInputError(f"infer: refused by --strict, as something is suspected: {suspicions.lines()[0]}")
