"""Stone Soup's trackers, rivals in `association.py`: nearest neighbours (GNN) and JPDA, both with RTS smoothing.

JPDA's probabilities are computed by efficient hypothesis management (Maskell, Briers, Wright 2004; `JPDAwithEHM` of Stone
Soup): the same numbers as by listing all joint hypotheses, which takes too long where a dozen tracks share a gate.
"""

import datetime
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from association_logs import Estimate, Log

from cadence.arrays import Float64s
from cadence.association.types import CLUTTER
from pipeline.manifest import write_atomic

KINDS = ("GNN", "JPDA")
NUM_SAMPLES = 60
_EPOCH = datetime.datetime(2026, 1, 1)
_FACTORS = {"diffusion": 10.0**0.5, "gate": 4.0 / 3.0, "patience_s": 2.0}


@dataclass(frozen=True)
class Settings:
    """Of a tracker: intensity of the acceleration noise, gate in standard deviations, density of false detections, patience."""

    diffusion: float
    gate: float
    clutter_per_m2: float
    patience_s: float


def searched(kind: str, logs: Sequence[Log], starts: Sequence[Settings], folder: Path) -> Settings:
    """The settings of least mean GOSPA on `logs`: from the best start on one value after the other, as far as it gets better.

    Ranges are open, so that the best lies within what was tried. One file a setting in `folder`.
    """
    best = min(starts, key=lambda start: _mean_gospa(kind, logs, start, folder))
    for name, factor in _FACTORS.items():
        for step in (1.0 / factor, factor):
            while True:
                further = replace(best, **{name: float(f"{getattr(best, name) * step:.2g}")})
                if _mean_gospa(kind, logs, further, folder) >= _mean_gospa(kind, logs, best, folder):
                    break
                best = further
    return best


def _mean_gospa(kind: str, logs: Sequence[Log], settings: Settings, folder: Path) -> float:
    from association_scores import gospas

    name = "_".join(f"{value:.3g}" for value in asdict(settings).values())
    file = folder / f"{kind}_{name}.json"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        estimates = [tracked(kind, settings, log) for log in logs]
        mean = np.mean([gospas(estimate.position_m, log)[:, 0].mean() for estimate, log in zip(estimates, logs, strict=True)])
        write_atomic(file, json.dumps(float(mean)))
    return float(json.loads(file.read_text(encoding="utf-8")))


def tracked(kind: str, settings: Settings, log: Log) -> Estimate:
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
    order = sorted(found, key=lambda track: (-sum(isinstance(state, Update) for state in track), track[0].timestamp, track.id))
    grid_index = {_stamp(moment): index for index, moment in enumerate(log.grid_s)}
    parts = []
    for number, track in enumerate(order[: log.num_agents]):
        updates = [index for index, state in enumerate(track.states) if isinstance(state, Update)]
        for index in updates:
            seen = numbers.get(_likeliest_measurement(track.states[index].hypothesis))
            if seen is not None:
                label[seen] = number
        parts.append(_on_grid(smoother.smooth(track), updates, grid_index, log.num_agents is not None))
    if not parts:
        return Estimate(np.full((1, len(log.grid_s), 2), np.nan), label)
    mean, covariance = (np.stack(values) for values in zip(*parts, strict=True))
    noise = np.random.default_rng(0).standard_normal((NUM_SAMPLES, *mean.shape))
    root = np.linalg.cholesky(covariance + 1e-9 * np.eye(2))
    return Estimate(mean, label, None, mean + np.einsum("atij,katj->kati", root, noise))


def _stamp(moment: float) -> datetime.datetime:
    return _EPOCH + datetime.timedelta(seconds=float(moment))


def _likeliest_measurement(hypothesis: object) -> object:
    """The detection that a hypothesis, or most of a mixture of hypotheses, gives to a track."""
    if hasattr(hypothesis, "single_hypotheses"):
        return max((single for single in hypothesis if single), key=lambda single: float(single.probability)).measurement
    return getattr(hypothesis, "measurement", None)


def _on_grid(
    track: Sequence, updates: list[int], grid_index: dict[datetime.datetime, int], is_held: bool
) -> tuple[Float64s, Float64s]:
    """Smoothed positions [T, 2] and covariances from first to last detection; held beyond where all are always there."""
    mean, covariance = np.full((len(grid_index), 2), np.nan), np.broadcast_to(np.eye(2), (len(grid_index), 2, 2)).copy()
    last = updates[-1] if updates else 0
    for state in track[: last + 1]:
        index = grid_index.get(state.timestamp)
        if index is not None:
            mean[index], covariance[index] = _position(state)
    if is_held:
        for end, is_beyond in ((0, lambda stamp: stamp < track[0].timestamp), (last, lambda s: s > track[last].timestamp)):
            for stamp, index in grid_index.items():
                if is_beyond(stamp):
                    mean[index], covariance[index] = _position(track[end])
    return mean, covariance


def _position(state) -> tuple[Float64s, Float64s]:
    """Mean [2] and covariance [2, 2] of a state's position."""
    return np.ravel(state.state_vector)[[0, 2]].astype(float), np.asarray(state.covar, dtype=float)[np.ix_([0, 2], [0, 2])]


def _tracker(kind: str, settings: Settings, log: Log):
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDAwithEHM
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
        inside = 1.0 - np.exp(-0.5 * settings.gate**2)
        probability = PDAHypothesiser(predictor, updater, settings.clutter_per_m2, log.seen_share, inside)
        associator, tracker_class = JPDAwithEHM(probability), MultiTargetMixtureTracker
    deleter = UpdateTimeDeleter(datetime.timedelta(seconds=settings.patience_s))
    tracker = tracker_class(SimpleMeasurementInitiator(prior, measured), deleter, None, associator, updater)
    return tracker, KalmanSmoother(motion), measured
