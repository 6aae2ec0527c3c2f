"""Recorded episodes of the original Prison Escape simulator with what their sensors did: where they looked, what they saw.

Whether a sensor detects depends on where it stands (coverage, from the recorded terrain) and on the distance. The curves of
P(detect) over distance / coverage are fitted on other episodes than those that are scored, a kind of sensor each.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cadence.arrays import Bools, Float64s
from cadence.evidence.fitting import fit_curve
from cadence.evidence.footprints import DetectionCurve
from cadence.evidence.silence import Looks
from pipeline.logs.decode import Decoder, decoder_for
from pipeline.logs.reader import open_log
from schemas.tables import DETECTIONS

STEP_S, CELL_M = 60.0, 21.0
TARGET = "fugitive"
KINDS = ("camera", "helicopter", "search_party")


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """One log as arrays.

    start_ns    of its first step; steps are a minute long
    truth_m     [T, 2]
    sensors_m   by kind [S, T, 2]; cameras stand
    is_hit      by kind [S, T] which sensor detected the target
    """

    name: str
    start_ns: int
    truth_m: Float64s
    sensors_m: Mapping[str, Float64s]
    is_hit: Mapping[str, Bools]

    @property
    def is_detected(self) -> Bools:
        """Steps [T] at which any sensor detected the target."""
        found: Bools = np.any([hit.any(axis=0) for hit in self.is_hit.values()], axis=0)
        return found

    def detections(self) -> pa.Table:
        """DETECTIONS: one a step, exact up to a metre."""
        steps = np.flatnonzero(self.is_detected)
        rows = [
            {
                "log_id": self.name, "time_ns": self.start_ns + int(step * STEP_S) * 10**9, "sensor_id": "any",
                "agent_id": TARGET, "x_m": self.truth_m[step, 0], "y_m": self.truth_m[step, 1], "cov_xx_m2": 1.0,
                "cov_xy_m2": 0.0, "cov_yy_m2": 1.0, "num_merged": 1, "topic": "/d", "log_time_ns": 0, "sequence": index,
            }
            for index, step in enumerate(steps.tolist())
        ]  # fmt: skip
        return pa.Table.from_pylist(rows, schema=DETECTIONS)

    def is_looking(self, kind: str) -> Bools:
        """Which sensors look at each step [S, T]: a helicopter that does not move is on the ground."""
        place = self.sensors_m[kind]
        if kind != "helicopter":
            return np.ones(place.shape[:2], dtype=bool)
        moves = (np.diff(place, axis=1) != 0).any(axis=-1)
        return np.pad(moves, ((0, 0), (1, 0)), mode="edge") | np.pad(moves, ((0, 0), (0, 1)), mode="edge")


def read_episode(path: Path) -> RecordedEpisode:
    """The arrays of one log."""
    log = open_log(path)
    decoders: dict[str, Decoder] = {channel.topic: decoder_for(channel) for channel in log.channels}
    content: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in decoders}
    for message in log.messages():
        topic = message.channel.topic
        content[topic].append((message.log_time_ns, decoders[topic](message.data)))
    truth = content["/truth/fugitive"]
    start_ns = truth[0][0]
    truth_m = np.array([_place(fields["pose"]) for _, fields in truth])
    movers_m = np.array([[_place(pose) for pose in fields["poses"]] for _, fields in content["/trackers"]]).swapaxes(0, 1)
    (_, mission), *_ = [record for record in log.metadata() if record[0] == "mission"]
    cameras_m = np.array(json.loads(mission["cameras"]))
    sensors_m = {
        "camera": np.repeat(cameras_m[:, None], len(truth_m), axis=1), "helicopter": movers_m[:1], "search_party": movers_m[1:],
    }  # fmt: skip
    is_hit = {kind: np.zeros(place.shape[:2], dtype=bool) for kind, place in sensors_m.items()}
    for time_ns, fields in content.get("/detections", []):
        kind, number = _sensor(fields["sensor_id"])
        is_hit[kind][number, round((time_ns - start_ns) * 1e-9 / STEP_S)] = True
    return RecordedEpisode(path.stem, start_ns, truth_m, sensors_m, is_hit)


def _place(pose: Mapping[str, Any]) -> list[float]:
    return [pose["position"]["x"], pose["position"]["y"]]


def _sensor(name: str) -> tuple[str, int]:
    """Kind and number of a sensor; cameras that the target knows come first among all cameras."""
    word, _, number = name.rpartition("_")
    return ("camera", int(number) + 45 * (word == "unknown_camera")) if "camera" in word else (word, int(number))


def read_coverage(reference: Path) -> Float64s:
    """The recorded terrain [X, Y]: what ranges are multiplied by."""
    return np.asarray(np.load(reference / "terrain.npz")["coverage_1e4"] * 1e-4, dtype=np.float64)


def coverage_at(coverage: Float64s, position_m: Float64s) -> Float64s:
    """Coverage [...] where sensors [..., 2] stand."""
    cell = np.clip((position_m / CELL_M).astype(np.int64), 0, len(coverage) - 1)
    return np.asarray(coverage[cell[..., 0], cell[..., 1]])


def fit_curves(episodes: Iterable[RecordedEpisode], coverage: Float64s) -> dict[str, DetectionCurve]:
    """P(detect) over distance / coverage by kind of sensor, from where the target of these episodes really was."""
    distance: dict[str, list[Float64s]] = {kind: [] for kind in KINDS}
    is_hit: dict[str, list[Bools]] = {kind: [] for kind in KINDS}
    for episode in episodes:
        for kind in KINDS:
            place = episode.sensors_m[kind]
            looks = episode.is_looking(kind)
            away = np.linalg.norm(place - episode.truth_m, axis=-1) / coverage_at(coverage, place)
            distance[kind].append(away[looks])
            is_hit[kind].append(episode.is_hit[kind][looks])
    found = {kind: fit_curve(np.concatenate(distance[kind]), np.concatenate(is_hit[kind])) for kind in KINDS}
    return {kind: fitted.curve for kind, fitted in found.items() if fitted is not None}


def looks_of(
    episode: RecordedEpisode, curves: Mapping[str, DetectionCurve], coverage: Float64s, kinds: Sequence[str] = KINDS
) -> tuple[Looks, ...]:
    """All looks of an episode, and which of them saw the target."""
    found = []
    for kind in kinds:
        looking = episode.is_looking(kind)
        step, sensor = np.nonzero(looking.T)
        place = episode.sensors_m[kind][sensor, step]
        seen = tuple(frozenset({TARGET}) if hit else frozenset() for hit in episode.is_hit[kind][sensor, step].tolist())
        range_m = coverage_at(coverage, place)
        found.append(Looks(step * STEP_S, place, range_m, np.zeros(len(step)), curves[kind], seen=seen))
    return tuple(found)
