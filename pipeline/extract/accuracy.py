"""How accurate detections are that do not say so, by their own likelihood; and statements that cannot be meant.

Each source, a topic or a sensor of it, has its own noise (`cadence.measurement`). Sources that say too little alone are taken
together with others of their message type. Rows without a name tell of it where they may be one target's.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.measurement.noise import MeasurementNoise, Track, covariances_m2, measurement_noise, roughness_m
from pipeline.accuracies import Accuracy
from pipeline.counted import counted
from pipeline.extract.one_target import is_one_target
from pipeline.extract.positions import Positions
from pipeline.suspicions import Suspicions

_MIN_STRETCHES: Final = 12
"""Of a source that is not taken together with others."""
_MAX_ROWS: Final = 4096
"""More rows of a track would not tell more."""
_MIN_VAGUE_M: Final = 100.0
_VAGUE_RATIO: Final = 1000.0
"""Smoothed positions scatter less than they are off, by a hundred times at most; by a thousand where a driver writes 1e6 m²."""
_SURE_RATIO: Final = 10.0
_EASY_MPS2: Final = 0.05
_BEND: Final = 6.0**0.5
"""Of noise in the second differences of positions. What walks from cell to cell of a grid once a minute seems to be noisy."""
_LEAST_M: Final = 1e-3
_ABSURD_RATIO: Final = 1000.0
"""A receiver that has just resolved its ambiguities claims to be some hundred times as exact as before, never below this."""


_MIN_CLAIMING: Final = 8
_AS_STATED: Final = (0.6, 1.25)
"""Of the scatter about neighbours in what is stated: elsewhere turns of the target, or smoothing, hide what noise there is."""
_OVERSTATED: Final = 2.0
"""Of the same where exact positions are claimed: 1 where they are exact, 3 where they are as noisy as the others."""


@dataclass(frozen=True, eq=False)
class _Source:
    """The rows of a source, and its targets' tracks, each with its rows."""

    name: str
    kind: str
    rows: Int64s
    tracks: list[tuple[Int64s, Track]]

    @property
    def ways(self) -> list[Track]:
        """The tracks, as long as is worth looking at."""
        return [Track(track.time_s[:_MAX_ROWS], track.position_m[:_MAX_ROWS]) for _, track in self.tracks]


def with_accuracy(
    rows: Positions, told_topics: Collection[str], has_default: bool, kinds: Mapping[str, str], suspicions: Suspicions
) -> tuple[Positions, list[Accuracy]]:
    """Detections [N], in metres, with a covariance where they state none and show noise; and what was found of each source.

    `told_topics` have an accuracy of the user's, who with `has_default` has one for all others that state none. `kinds` are the
    message types of topics. Statements that the detections contradict are not believed, and suspected.
    """
    covariance = rows.covariance_m2.copy()
    sources = [source for source in _sources(rows, kinds) if rows.topic[source.rows[0]] not in told_topics]
    if suspicions.looks_for("covariance"):
        for source in sources:
            _mend_absurd(source, covariance, suspicions)
            stated = source.rows[~np.isnan(covariance[source.rows, 0])]
            if _is_contradicted(source, covariance[stated], suspicions):
                covariance[stated] = np.nan
    found = []
    open_sources = [s for s in sources if not has_default and np.isnan(covariance[s.rows, 0]).any()]
    for group, noise in _noises(open_sources):
        is_open = np.isnan(covariance[:, 0])
        number = sum(int(is_open[source.rows].sum()) for source in group)
        found.append(Accuracy(tuple(source.name for source in group), number, noise))
        if noise is None or not noise.is_sure:
            continue
        for of_track, track in (pair for source in group for pair in source.tracks):
            filled = covariances_m2(track, noise)[:, [0, 0, 1], [0, 1, 1]]
            covariance[of_track[is_open[of_track]]] = filled[is_open[of_track]]
    return rows.changed(covariance_m2=covariance), found


def _noises(sources: Sequence[_Source]) -> list[tuple[list[_Source], MeasurementNoise | None]]:
    """Sources with their noise: each alone where it says enough, else together with those of its kind that do not."""
    found: list[tuple[list[_Source], MeasurementNoise | None]] = []
    weak: dict[str, list[_Source]] = {}
    for source in sources:
        noise = measurement_noise(source.ways)
        if noise is not None and noise.num_stretches >= _MIN_STRETCHES:
            found.append(([source], noise))
        else:
            weak.setdefault(source.kind, []).append(source)
    return found + [(group, measurement_noise([way for source in group for way in source.ways])) for group in weak.values()]


def _mend_absurd(source: _Source, covariance_m2: Float64s, suspicions: Suspicions) -> None:
    """Give the few rows of a source that claim to be a thousand times as exact as the others the others' covariance [N, 3]."""
    stated = source.rows[~np.isnan(covariance_m2[source.rows, 0])]
    if not len(stated):
        return
    sigma_m = np.sqrt(covariance_m2[stated][:, [0, 2]].min(axis=1))
    usual_m = float(np.median(sigma_m))
    is_absurd = (sigma_m < _LEAST_M) & (sigma_m < usual_m / _ABSURD_RATIO)
    if not is_absurd.any():
        _mend_overstated(source, stated[sigma_m < usual_m / _SURE_RATIO], usual_m, covariance_m2, suspicions)
        return
    covariance_m2[stated[is_absurd]] = np.median(covariance_m2[stated[~is_absurd]], axis=0)
    number = int(is_absurd.sum())
    states = counted(number, f"of {len(stated)} detections states", f"of {len(stated)} detections state")
    suspicions.add(
        "covariance", source.name,
        seen=f"{states} a standard deviation of {sigma_m[is_absurd].max():.2g} m at most, the others {usual_m:.3g} m",
        done="taken as exact as the others", setting='extract.trusted = ["covariance"]',
    )  # fmt: skip


def _mend_overstated(
    source: _Source, claiming: Int64s, usual_m: float, covariance_m2: Float64s, suspicions: Suspicions
) -> None:
    """Give the rows that claim to be far more exact than the others, and scatter as those do, the others' covariance [N, 3].

    Between two neighbours with the usual noise an exact position scatters by a third of the variance of one as noisy.
    """
    if not _MIN_CLAIMING <= len(claiming) < len(source.rows) / 2:
        return
    is_claiming = np.zeros(len(covariance_m2), np.bool_)
    is_claiming[claiming] = True
    claimed, usual = list[Float64s](), list[Float64s]()
    for of_track, track in source.tracks:
        residual_m2, weight = _between(track)
        inner = is_claiming[of_track[1:-1]]
        claimed.append((residual_m2 / weight)[inner])
        usual.append((residual_m2 / (1 + weight))[~inner])
    noise = np.concatenate(usual) / (2 * usual_m**2) if usual else np.zeros(0)
    claims = np.concatenate(claimed) / (2 * usual_m**2) if claimed else np.zeros(0)
    if len(claims) < _MIN_CLAIMING or not _AS_STATED[0] < float(np.mean(noise)) < _AS_STATED[1]:
        return
    if float(np.mean(claims)) < _OVERSTATED:
        return
    sigma_m = float(np.sqrt(covariance_m2[claiming][:, [0, 2]].max()))
    covariance_m2[claiming] = np.median(covariance_m2[source.rows[~is_claiming[source.rows]]], axis=0)
    state = counted(len(claiming), f"of {len(source.rows)} detections states", f"of {len(source.rows)} detections state")
    suspicions.add(
        "covariance", source.name,
        seen=f"{state} a standard deviation of {sigma_m:.2g} m at most, but scatter as the others do, with {usual_m:.3g} m",
        done="taken as exact as the others", setting='extract.trusted = ["covariance"]',
    )  # fmt: skip


def _between(track: Track) -> tuple[Float64s, Float64s]:
    """Squared distances [N - 2] of positions from the line between their neighbours, and the weight of these in variance."""
    if len(track.time_s) < 3:
        return np.zeros(0), np.ones(0)
    before_s, whole_s = track.time_s[1:-1] - track.time_s[:-2], track.time_s[2:] - track.time_s[:-2]
    share = np.divide(before_s, whole_s, out=np.full(len(before_s), 0.5), where=whole_s > 0)
    line_m = track.position_m[:-2] + share[:, None] * (track.position_m[2:] - track.position_m[:-2])
    return np.sum((track.position_m[1:-1] - line_m) ** 2, axis=1), share**2 + (1 - share) ** 2


def _is_contradicted(source: _Source, covariance_m2: Float64s, suspicions: Suspicions) -> bool:
    """Whether detections are far from as accurate as they state."""
    if not len(covariance_m2) or not source.tracks:
        return False
    stated_m, most_m = float(np.sqrt(np.median(covariance_m2[:, [0, 2]].mean(axis=1)))), roughness_m(source.ways)
    is_vague = stated_m >= _MIN_VAGUE_M and stated_m > _VAGUE_RATIO * most_m
    noise = None
    if is_vague or most_m > _SURE_RATIO * stated_m:
        noise = measurement_noise(source.ways)
    is_sure = noise is not None and noise.sigma_interval_m[0] > max(_SURE_RATIO * stated_m, _could_be_motion_m(source))
    if noise is None or not (is_vague or is_sure):
        return False
    done = f"{noise.sigma_m:.3g} m are taken" if noise.is_sure else "taken as not stated"
    seen = f"a standard deviation of {stated_m:.3g} m is stated, but the detections scatter by {noise.sigma_m:.3g} m"
    suspicions.add("covariance", source.name, seen=seen, done=done, setting='extract.trusted = ["covariance"]')
    return True


def _could_be_motion_m(source: _Source) -> float:
    """The scatter that nobody needs noise to make, between detections as far apart as they mostly are."""
    steps_s = np.concatenate([np.diff(way.time_s) for way in source.ways])
    return _EASY_MPS2 * float(np.median(steps_s)) ** 2 / _BEND if len(steps_s) else 0.0


def _sources(rows: Positions, kinds: Mapping[str, str]) -> list[_Source]:
    topics, sensors, agents = rows.topics.number, rows.sensors.number, rows.agents.number
    keys = np.column_stack([topics, sensors])
    found = []
    for key in np.unique(keys, axis=0):
        of_source = np.flatnonzero((keys == key).all(1))
        topic, sensor = str(rows.topic[of_source[0]]), rows.sensor[of_source[0]]
        is_only = len(np.unique(sensors[topics == key[0]])) == 1
        name = topic if sensor is None or is_only else f"{topic} sensor {sensor}"
        order = of_source[np.argsort(agents[of_source], kind="stable")]
        parts = np.split(order, np.flatnonzero(np.diff(agents[order])) + 1)
        tracks = [track for part in parts for track in _track(rows, part, bool(agents[part[0]] >= 0))]
        found.append(_Source(name, kinds.get(topic, topic), of_source, tracks))
    return found


def _track(rows: Positions, part: Int64s, is_named: bool) -> list[tuple[Int64s, Track]]:
    """Rows by time, and the track that they make; none where they have no name and may be several targets'."""
    part = part[np.argsort(rows.time_ns[part], kind="stable")]
    track = Track((rows.time_ns[part] - rows.time_ns[part[0]]) * 1e-9, np.column_stack([rows.first[part], rows.second[part]]))
    if is_named:
        return [(part, track)]
    is_new = np.diff(track.time_s, prepend=-np.inf) > 0
    is_each = len(np.unique(rows.message[part])) == len(part)
    return [(part, track)] if is_each and is_one_target(track.time_s[is_new], track.position_m[is_new]) else []
