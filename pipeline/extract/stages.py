"""The same objects on several channels: detected, tracked and predicted by one pipeline, they are no independent looks.

Of such channels one is used. They are known by their names, which differ in nothing but words for a stage of work, and by what
they hold: the same places at the same moments.
"""

import itertools
from collections.abc import Collection, Mapping
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from pipeline.extract.positions import Positions
from pipeline.mapping.topic_names import family_of, words_of
from pipeline.suspicions import Suspicions

_COINCIDE: Final = 0.7
"""Of the positions of the channel that has fewer. A tracker confirms late and drops some; what is independent coincides by
chance only."""
_MIN_SHARE: Final = 0.5
_MIN_ROWS: Final = 5
_MAX_ROWS: Final = 2000
_SAME_MOMENT_NS: Final = 1_000_000
_SIGMAS: Final = 4.0
_WORK: Final = (
    {"raw"},
    {"fused", "fusion", "merged", "combined"},
    {"filtered", "filter", "smoothed", "corrected", "validated", "confirmed"},
    {"tracked", "tracking", "track", "tracks"},
    {"predicted", "prediction", "predictions", "forecast"},
)
"""Stages behind that of plain detections. The less was made of them, the more independent are their errors."""


def without_other_stages(rows: Positions, schemas: Mapping[str, str], suspicions: Suspicions) -> Positions:
    """The rows [N] of detections, in metres and sorted by time, of one stage of every pipeline.

    `schemas` are the schema names by topic that nobody stated: whoever names several stages wants them.
    """
    if not suspicions.looks_for("stage") or len(schemas) < 2:
        return rows
    is_kept = np.ones(len(rows), np.bool_)
    for stages in _pipelines(rows, schemas):
        best = _best(stages, schemas)
        others = [topic for topic in stages if topic != best]
        is_other = np.array([topic in others for topic in rows.topics.names])[rows.topics.number]
        is_kept &= ~is_other
        reason = "which says who was seen" if _is_named(stages[best]) else "of which least was made"
        suspicions.add(
            "stage", ", ".join(stages),
            seen=f"over {_COINCIDE:.0%} of their positions are the same at the same moments, as of stages of one work",
            done=f"{best} is used, {reason}; {int(is_other.sum())} detections of {', '.join(others)} are left out",
            setting="name those to use under [[extract.detections]]",
        )  # fmt: skip
    return rows[is_kept]


def _best(stages: Mapping[str, Positions], schemas: Mapping[str, str]) -> str:
    """The stage that says who was seen, which saves guessing it, unless it holds little; of several that of least work."""
    most = max(map(len, stages.values()))
    names = {topic: _is_named(found) and len(found) >= _MIN_SHARE * most for topic, found in stages.items()}
    return min(stages, key=lambda topic: (not names[topic], _work(topic, schemas[topic]), -len(stages[topic]), topic))


def _pipelines(rows: Positions, topics: Collection[str]) -> list[dict[str, Positions]]:
    """The channels by topic that hold the same objects, together."""
    at = {topic: found for topic, found in zip(rows.topics.names, rows.topics.rows(), strict=True) if topic in topics}
    families = {topic: family_of(topic) for topic, found in at.items() if len(found) >= _MIN_ROWS}
    group, found = {topic: topic for topic in families}, dict[str, Positions]()
    for one, other in itertools.combinations(families, 2):
        is_kin = families[one] <= families[other] or families[other] <= families[one]
        if not is_kin or group[one] == group[other]:
            continue
        found |= {topic: rows[at[topic]] for topic in (one, other) if topic not in found}
        if _coincide(found[one], found[other], families[one] == families[other]):
            group = {topic: group[one] if name == group[other] else name for topic, name in group.items()}
    members = [[topic for topic in group if group[topic] == name] for name in dict.fromkeys(group.values())]
    return [{topic: found[topic] for topic in each} for each in members if len(each) > 1]


def _coincide(one: Positions, other: Positions, is_one_family: bool) -> bool:
    """Whether two channels hold the same places at the same moments.

    A tracker may run by its own clock and tell of moments between; where also the names differ, only equal stamps tell.
    """
    few, many = sorted((one, other), key=len)
    moments_ns = np.unique(many.time_ns)
    between_ns = float(np.median(np.diff(moments_ns))) / 2 if is_one_family and len(moments_ns) > 1 else 0.0
    near_ns, gate_m = max(_SAME_MOMENT_NS, between_ns), _gate_m(few, many)
    scaled = [
        np.column_stack([(rows.time_ns - many.time_ns[0]) / near_ns, rows.first / gate_m, rows.second / gate_m])
        for rows in (few[:: 1 + len(few) // _MAX_ROWS], many)
    ]
    distance, _ = cKDTree(scaled[1]).query(scaled[0], p=np.inf, distance_upper_bound=1.0)
    return bool(np.isfinite(distance).mean() >= _COINCIDE)


def _gate_m(few: Positions, many: Positions) -> float:
    """How far apart two stages may put one object: by what they state, or by what it moves between two moments."""
    variance_m2 = [np.median(np.nan_to_num(rows.covariance_m2[:, [0, 2]].max(axis=1))) for rows in (few, many)]
    begins = np.flatnonzero(np.diff(many.time_ns)) + 1
    ends = [*begins[1:].tolist(), len(many)]
    steps_m = [
        np.hypot(many.first[begin:end] - many.first[begin - 1], many.second[begin:end] - many.second[begin - 1]).min()
        for begin, end in zip(begins.tolist(), ends, strict=True)
    ]
    return float(max(_SIGMAS * np.sqrt(sum(variance_m2)), np.median(steps_m) if steps_m else 0.0, 1e-9))


def _is_named(rows: Positions) -> bool:
    return bool((rows.agents.number >= 0).all())


def _work(topic: str, schema: str) -> int:
    """How much was made of plain detections, by what the topic and its type are called."""
    words = {*words_of(topic), *words_of(schema.replace("::", "/").rpartition("/")[2].rpartition(".")[2])}
    return max((place for place, stage in enumerate(_WORK, 1) if words & stage), default=0)
