#!/usr/bin/env bash
# Stone Soup 1.9.1: what is learned after a missed scan never reaches the states before it when a track is smoothed.
#
# Behaviour. KalmanSmoother.smooth goes through a track from its end and asks each state that it has smoothed for what the filter
# had predicted there. A scan without a detection leaves a prediction in the track, and such a state answers with itself, smoothed
# already: smoothed minus predicted is zero, so that the state before it stays as the filter left it, and the recursion begins
# anew from there. The textbook (Rauch, Tung, Striebel 1965) goes on. Issue 178 of the project, which asks what to do with states
# that are not updates, has been open since 2020.
#
# Input. One target on a line, constant velocity with white acceleration noise, eight scans at irregular times, filtered by
# Stone Soup's own predictor and updater; once detected in every scan, once missed in two of them.
#
# Output seen:
#   stonesoup 1.9.1
#   largest difference of the smoother from the direct solution, every scan detected: 0.0000 m
#   the same, two scans missed: 5.6228 m before the last missed scan, 0.0000 m from it on
#   the last detection moved by 30 m moves the state before the last missed scan by 0.0000 m; right: 0.6534 m
#   as stated
#
# Exit: 0 the behaviour is as stated, 1 it is another one, 2 the packages could not be installed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv" || exit 2
"$folder/venv/bin/python" -m pip install --quiet stonesoup==1.9.1 numpy==2.4.6 scipy==1.17.1 >"$folder/pip.log" 2>&1 || {
  tail -n 3 "$folder/pip.log" >&2
  exit 2
}

cat > "$folder/probe.py" <<'PROBE'
import datetime
import importlib.metadata
import sys

import numpy as np
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.smoother.kalman import KalmanSmoother
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.types.update import GaussianStateUpdate
from stonesoup.updater.kalman import KalmanUpdater

START = datetime.datetime(2026, 1, 1)
SCANS_S = [0, 10, 20, 50, 60, 90, 100, 130]
PLACES_M = [0.0, 32.0, 61.0, 170.0, 195.0, 222.0, 230.0, 250.0]
VARIANCE_M2, SPEED_VARIANCE, INTENSITY = 9.0, 16.0, 0.02


def smoothed(places_m, missed):
    """Positions at all scans by Stone Soup's filter and smoother."""
    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(INTENSITY)])
    sensor = LinearGaussian(2, (0,), np.array([[VARIANCE_M2]]))
    predictor, updater = KalmanPredictor(motion), KalmanUpdater(sensor)
    stamps = [START + datetime.timedelta(seconds=second) for second in SCANS_S]
    detections = [Detection([[place]], timestamp=stamp) for place, stamp in zip(places_m, stamps)]
    first = GaussianState([[places_m[0]], [0.0]], np.diag([VARIANCE_M2, SPEED_VARIANCE]), timestamp=START)
    begin = SingleHypothesis(None, detections[0])
    track = Track([GaussianStateUpdate(first.state_vector, first.covar, begin, timestamp=START)])
    for scan in range(1, len(SCANS_S)):
        prediction = predictor.predict(track[-1], timestamp=stamps[scan])
        hit = SingleHypothesis(prediction, detections[scan])
        track.append(prediction if scan in missed else updater.update(hit))
    return np.array([float(state.state_vector[0]) for state in KalmanSmoother(motion).smooth(track)])


def direct(places_m, missed):
    """The posterior mean of all states at once: the normal equations of motion, detections and the prior of the speed."""
    num = len(SCANS_S)
    precision, right = np.zeros((2 * num, 2 * num)), np.zeros(2 * num)
    precision[1, 1] = 1.0 / SPEED_VARIANCE
    for scan, dt in enumerate(np.diff(SCANS_S)):
        row = np.zeros((2, 2 * num))
        row[:, 2 * scan : 2 * scan + 4] = [[-1.0, -dt, 1.0, 0.0], [0.0, -1.0, 0.0, 1.0]]
        cover = INTENSITY * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        precision += row.T @ np.linalg.solve(cover, row)
    for scan in set(range(num)) - missed:
        precision[2 * scan, 2 * scan] += 1.0 / VARIANCE_M2
        right[2 * scan] += places_m[scan] / VARIANCE_M2
    return np.linalg.solve(precision, right)[::2]


missed, last = {3, 5}, 5
moved_m = [*PLACES_M[:-1], PLACES_M[-1] + 30.0]
whole = np.abs(smoothed(PLACES_M, set()) - direct(PLACES_M, set())).max()
error = np.abs(smoothed(PLACES_M, missed) - direct(PLACES_M, missed))
before, after = error[:last].max(), error[last:].max()
gained, right = (np.abs(solve(moved_m, missed) - solve(PLACES_M, missed))[last - 1] for solve in (smoothed, direct))
print(f"stonesoup {importlib.metadata.version('stonesoup')}")
print(f"largest difference of the smoother from the direct solution, every scan detected: {whole:.4f} m")
print(f"the same, two scans missed: {before:.4f} m before the last missed scan, {after:.4f} m from it on")
print("the last detection moved by 30 m moves the state before the last missed scan", end=" ")
print(f"by {gained:.4f} m; right: {right:.4f} m")
is_as_stated = max(whole, after, gained) < 1e-6 and before > 3.0 and right > 0.1
print("as stated" if is_as_stated else "the behaviour is another one")
sys.exit(0 if is_as_stated else 1)
PROBE
"$folder/venv/bin/python" "$folder/probe.py"
