"""What is to be drawn of a log: its windows, the estimator that fits it, and what is said of both."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from cadence.association.counts import stream_counts
from cadence.association.types import AssociationConfig
from cadence.constraints.obstacles import Obstacles
from cadence.errors import ImplausibleInputError
from cadence.evidence.estimator import WithEvidence
from cadence.evidence.measurements import Measurements
from cadence.evidence.silence import Looks
from cadence.height.bank import HeightBeside
from cadence.types import Estimator, Evidence
from pipeline.associations import AssociatedWindows, Sources, build_associated_windows, tell_sources
from pipeline.checkpoints import DEFAULT
from pipeline.estimators.fit_test import FitTest, fit_test
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.loaded import Fitted, Loaded
from pipeline.estimators.presets import load_estimator
from pipeline.infer.config import InferConfig
from pipeline.infer.draws import Piece, draw_associations, draw_tracks, draw_windows
from pipeline.infer.measuring import drawn_by_measurements, hear_measurements, with_unseen
from pipeline.infer.silence import hear_silence
from pipeline.looks import Footprint
from pipeline.progress import Progress
from pipeline.stream_words import stream_words
from pipeline.suspicions import Suspicions
from pipeline.windows import MissionWindows, build_windows

_SHARE_APART = 0.4
"""Of the time, what telling detections apart takes where there is something to tell apart."""
_FIT_AS_DRAWN = 4.0
"""Fitting takes about as long as drawing so many windows of an agent."""
_FIT_STEPS = 10
"""Of fitting: tests one, the bank four, the network's part three, silence what is left."""


@dataclass(frozen=True, eq=False)
class Beside:
    """What is known of a mission beside its detections.

    When it began, obstacles, what else speaks, where sensors looked, and what they measured that is no position.
    """

    start_ns: int
    obstacles: Obstacles
    evidence: tuple[Evidence, ...] = ()
    looks: tuple[tuple[Footprint, Looks], ...] = ()
    measurements: Measurements | None = None


@dataclass(frozen=True, eq=False)
class Seen:
    """The windows, by name; `associated` where they have several association hypotheses."""

    sources: Sources
    named: MissionWindows
    associated: AssociatedWindows | None

    @staticmethod
    def of(config: InferConfig, detections: pa.Table, loaded: Loaded, progress: Progress) -> "Seen":
        """The windows of a log on the grid that the model takes."""
        sigma_m, association = config.default_sigma_m, config.association if config.is_associated else None
        grid = loaded.grid(config.grid)
        sources = tell_sources(detections, grid, association, config.seed, sigma_m, config.guidance.max_speed_mps, progress)
        named = build_windows(sources.named, sources.grid, config.seed, sigma_m)
        if sources.association is None:
            return Seen(sources, named, None)
        associated = build_associated_windows(detections, sources, config.seed, config.num_hypotheses, sigma_m)
        return Seen(sources, named, associated)

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
class Plan:
    """What is to be drawn: the windows, the draws as they come, and what the summary says of the model."""

    checkpoint: str
    seen: Seen
    draws: Iterator[Piece]
    about: Mapping[str, Any]
    suspicions: Suspicions
    max_speed_mps: float | None
    has_evidence: bool
    left: Progress
    remarks: tuple[str, ...] = ()

    @property
    def found(self) -> list[str]:
        """What a stream without identity turned out to be, in words."""
        words = stream_words(self.about.get("association", {}))
        return [*([words] if words else []), *self.remarks]

    @staticmethod
    def of(config: InferConfig, detections: pa.Table, beside: Beside, progress: Progress) -> "Plan":
        """The draws of a log by the checkpoint, which decides the grid as well, or by the default one where it does not fit.

        `progress` is that of the whole stage; `left` is the part that drawing takes.
        """
        loaded = load_estimator(config.checkpoint, config.samplings)
        seen = Seen.of(config, detections, loaded, progress.part(0.0, _SHARE_APART))
        fitting, left = _shares(seen, progress)
        data = FittingData.of(seen.sources.named, seen.sources.grid, seen.named, config.default_sigma_m)
        suspicions, about = Suspicions(), seen.about(config.association)
        if config.is_tested and loaded.fit is None:
            test = fit_test(loaded.estimator, data, seen.named.located(beside.start_ns, beside.obstacles))
            if test is not None and test.is_misfit:
                _suspect(test, config, suspicions)
                plan = Plan.of(replace(config, checkpoint=DEFAULT), detections, beside, progress)
                return replace(plan, suspicions=suspicions, about={**plan.about, "fit_test": asdict(test)})
            about["fit_test"] = None if test is None else asdict(test)
        fitted = _with_heights(_fitted(loaded, data, fitting), data)
        knows, start_ns = loaded.knows_standing, beside.start_ns
        if seen.associated is None:
            seen = replace(seen, named=with_unseen(seen.named, beside.measurements, config.evidence))
        given = beside.looks, beside.obstacles, config.evidence, fitted.estimator
        fitting.doing("infer: asking what silence tells" if beside.looks else "infer: drawing")
        silence = hear_silence(*given, seen.named, start_ns, knows)
        names = seen.named.agent_ids if seen.associated is None else seen.associated.windows.agent_ids
        measured = hear_measurements(beside.measurements, config.evidence, names)
        heard = (*beside.evidence, *silence.evidence, *measured.evidence)
        num, evidence = config.num_hypotheses, heard if config.evidence.is_used else ()
        if seen.associated is None:
            weighed = WithEvidence(fitted.estimator, config.evidence, loaded.is_apart, loaded.num_past)
            drawing: Estimator = weighed
            if measured.evidence:
                bank = data.fitted_bank().members[0]
                drawing = drawn_by_measurements(weighed, bank, config.evidence, config.guidance, seen.sources.grid.step_s)
            located = seen.named.located(beside.start_ns, beside.obstacles, evidence)
            draws = draw_windows(drawing, located, num, loaded.is_apart)
        else:
            associated = seen.associated.located(beside.start_ns, beside.obstacles, evidence)
            draw = draw_tracks if loaded.is_apart else draw_associations
            draws = draw(fitted.estimator, associated, num, config.evidence)
        about = {**fitted.about, **about, **silence.about, **measured.about}
        limit_mps = config.guidance.max_speed_mps
        remarks = *silence.remarks, *measured.remarks
        return Plan(config.checkpoint, seen, draws, about, suspicions, limit_mps, bool(evidence), left, remarks)

    @property
    def windows(self) -> MissionWindows:
        """What the tables speak of."""
        return self.seen.named if self.seen.associated is None else self.seen.associated.windows


def _shares(seen: Seen, progress: Progress) -> tuple[Progress, Progress]:
    """The progress of fitting and of drawing: what is fitted to is bounded, what is drawn grows with the log."""
    begin = 0.0 if seen.associated is None else _SHARE_APART
    num_drawn = int(seen.named.batch.is_active.sum())
    middle = begin + (1.0 - begin) * _FIT_AS_DRAWN / (_FIT_AS_DRAWN + num_drawn)
    return progress.part(begin, middle), progress.part(middle, 1.0)


def _fitted(loaded: Loaded, data: FittingData, progress: Progress) -> Fitted:
    """The estimator for one log, what it is fitted with first: each is found once, and kept by `data`."""
    if loaded.fit is None:
        return loaded.fitted(data)
    with progress.bar(_FIT_STEPS, "infer: fit", unit="step") as bar:
        data.tests  # noqa: B018
        bar.update(1)
        data.fitted_bank()
        bar.update(4)
        progress.doing("infer: testing on detections held back")
        fitted = loaded.fitted(data)
        bar.update(3)
    return fitted


def _with_heights(fitted: Fitted, data: FittingData) -> Fitted:
    """The estimator, and where detections have heights its hypotheses with heights beside them."""
    if data.tracks.height_m is None:
        return fitted
    bank = data.fitted_heights()
    return Fitted(HeightBeside(fitted.estimator, bank), {**fitted.about, "height": bank.about()})


def _suspect(test: FitTest, config: InferConfig, suspicions: Suspicions) -> None:
    """Say that the checkpoint is of another place; `ImplausibleInputError` where that is to be refused."""
    suspicions.add(
        "checkpoint", config.checkpoint, seen=f"it does not fit this log: {test}",
        done=f"hypotheses are drawn with {DEFAULT!r} instead", setting="infer.is_tested = false",
    )  # fmt: skip
    if config.is_strict:
        raise ImplausibleInputError(f"infer: refused by --strict, as something is suspected: {suspicions.lines()[0]}")
