"""Stone Soup's trackers, rivals in `association.py`: nearest neighbours (GNN) and JPDA, both with RTS smoothing.

What they are given: all detections with their noise, the typical speed of a target, the number of targets where it is known,
and settings that are searched on training logs. Motion is constant velocity, or velocity that forgets. JPDA's probabilities are
computed by efficient hypothesis management (Maskell, Briers, Wright 2004; `JPDAwithEHM` of Stone Soup): the same numbers as by
listing all joint hypotheses, which takes too long where a dozen tracks share a gate.
"""

import datetime
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.association_logs import Estimate, Log
from benchmarks.rts_smoother import rts_smoothed
from cadence.arrays import Float64s
from cadence.association.types import CLUTTER
from pipeline.files import write_atomic

KINDS = ("GNN", "JPDA")
NUM_SAMPLES = 60
_EPOCH = datetime.datetime(2026, 1, 1)
_FACTORS = {
    "diffusion": 10.0**0.5,
    "damping_per_s": 10.0**0.5,
    "gate": 4.0 / 3.0,
    "patience_s": 2.0,
    "clutter_per_m2": 100.0,
    "seen_share": 2.0,
}
_LEAST_GAIN = 0.999
"""What counts as better."""
_OF_JPDA = ("clutter_per_m2", "seen_share")
"""What nearest neighbours do not ask for."""


@dataclass(frozen=True)
class Settings:
    """Of a tracker.

    diffusion       intensity of the acceleration noise, m^2 s^-3
    damping_per_s   rate at which velocities are forgotten; 0: constant velocity
    gate            in standard deviations
    patience_s      a track without a detection for so long is given up
    clutter_per_m2  density of false detections in a scan
    seen_share      how likely it is that a scan holds a detection of a target
    """

    diffusion: float
    damping_per_s: float
    gate: float
    patience_s: float
    clutter_per_m2: float
    seen_share: float

    @property
    def label(self) -> str:
        """All values, for the names of files."""
        return "_".join(f"{value:.3g}" for value in asdict(self).values())


def searched(kind: str, logs: Sequence[Log], starts: Sequence[Settings], folder: Path) -> Settings:
    """The settings of least mean GOSPA on `logs`.

    For both kinds of motion, from the best start on until no step of a single value makes it better. Ranges are open, so that
    the best lies within what was tried. One file a setting in `folder`.
    """

    def cost(settings: Settings) -> float:
        return _mean_gospa(kind, logs, settings, folder)

    damped = [start for start in starts if start.damping_per_s]
    steady = [start for start in starts if not start.damping_per_s]
    return min((_searched_from(min(part, key=cost), kind, logs, folder) for part in (steady, damped)), key=cost)


def _searched_from(best: Settings, kind: str, logs: Sequence[Log], folder: Path) -> Settings:
    """The settings that one start leads to, first in whole steps, then in halves."""
    for part in (1.0, 0.5):
        before = None
        while best != before:
            before = best
            for name in _FACTORS:
                if kind == "JPDA" or name not in _OF_JPDA:
                    best = _searched_along(name, _FACTORS[name] ** part, kind, logs, best, folder)
    return best


def _searched_along(name: str, factor: float, kind: str, logs: Sequence[Log], best: Settings, folder: Path) -> Settings:
    """The best settings on the way down and up from `best` in one value, each as far as it gets better."""
    for step in (1.0 / factor, factor):
        while True:
            further = replace(best, **{name: float(f"{getattr(best, name) * step:.2g}")})
            is_possible = further != best and further.seen_share < 1.0
            least = _LEAST_GAIN * _mean_gospa(kind, logs, best, folder)
            if not is_possible or _mean_gospa(kind, logs, further, folder) >= least:
                break
            best = further
    return best


def _mean_gospa(kind: str, logs: Sequence[Log], settings: Settings, folder: Path) -> float:
    from benchmarks.association_scores import gospas

    file = folder / f"{kind}_{settings.label}.json"
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

    tracker, motion, model = _tracker(kind, settings, log)
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
        times = [track[index].timestamp for index in range(updates[-1] + 1)]
        parts.append(_on_grid(times, *_smoothed(track[: updates[-1] + 1], motion), grid_index, log.num_agents is not None))
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


def _smoothed(states: Sequence, motion) -> tuple[Float64s, Float64s]:
    """Smoothed positions [N, 2] and covariances [N, 2, 2] of a track's states.

    Only filtered moments are used: those of a state of JPDA without a clear detection are neither a prediction nor an update.
    """
    intervals = [later.timestamp - state.timestamp for state, later in itertools.pairwise(states)]
    mean, covariance = rts_smoothed(
        np.array([np.ravel(state.state_vector) for state in states], dtype=float),
        np.array([state.covar for state in states], dtype=float),
        [np.asarray(motion.matrix(time_interval=interval), dtype=float) for interval in intervals],
        [np.asarray(motion.covar(time_interval=interval), dtype=float) for interval in intervals],
    )
    return mean[:, [0, 2]], covariance[:, [0, 2]][:, :, [0, 2]]


def _on_grid(
    times: list[datetime.datetime],
    position: Float64s,
    covariance: Float64s,
    grid_index: dict[datetime.datetime, int],
    is_held: bool,
) -> tuple[Float64s, Float64s]:
    """Positions [T, 2] and covariances from first to last detection on the grid; held beyond where all are always there."""
    mean, spread = np.full((len(grid_index), 2), np.nan), np.broadcast_to(np.eye(2), (len(grid_index), 2, 2)).copy()
    row = {moment: index for index, moment in enumerate(times)}
    for moment, index in grid_index.items():
        nearest = min(max(moment, times[0]), times[-1]) if is_held else moment
        if nearest in row:
            mean[index], spread[index] = position[row[nearest]], covariance[row[nearest]]
    return mean, spread


def _tracker(kind: str, settings: Settings, log: Log):
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDAwithEHM
    from stonesoup.deleter.time import UpdateTimeDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import SimpleMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantVelocity,
        OrnsteinUhlenbeck,
    )
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.tracker.simple import MultiTargetMixtureTracker, MultiTargetTracker
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    axis = ConstantVelocity(settings.diffusion)
    if settings.damping_per_s:
        axis = OrnsteinUhlenbeck(settings.diffusion, settings.damping_per_s)
    motion = CombinedLinearGaussianTransitionModel([axis, axis])
    measured = LinearGaussian(4, (0, 2), np.eye(2) * max(log.sigma_m, 1.0) ** 2)
    predictor, updater = KalmanPredictor(motion), KalmanUpdater(measured)
    prior = GaussianState(np.zeros((4, 1)), np.diag([0.0, log.speed_mps**2, 0.0, log.speed_mps**2]), timestamp=_EPOCH)
    if kind == "GNN":
        associator = GNNWith2DAssignment(DistanceHypothesiser(predictor, updater, Mahalanobis(), settings.gate))
        tracker_class = MultiTargetTracker
    else:
        inside = 1.0 - np.exp(-0.5 * settings.gate**2)
        probability = PDAHypothesiser(predictor, updater, settings.clutter_per_m2, settings.seen_share, inside)
        associator, tracker_class = JPDAwithEHM(probability), MultiTargetMixtureTracker
    deleter = UpdateTimeDeleter(datetime.timedelta(seconds=settings.patience_s))
    tracker = tracker_class(SimpleMeasurementInitiator(prior, measured), deleter, None, associator, updater)
    return tracker, motion, measured
