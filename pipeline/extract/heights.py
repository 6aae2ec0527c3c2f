"""Heights of detections: whether there are any, what they count from, and how exact they are.

A log whose heights are all zero says none: messages have a field for them, and recorders leave it as it is. Heights above
different data are not mixed: between the ellipsoid and the sea lie up to a hundred metres, between the sea and the ground more.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from cadence.arrays import Bools, Float64s
from cadence.height.bank import HeightTrack
from cadence.height.noise import HeightNoise, height_noise
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.positions import Positions
from pipeline.height_words import height_words

_MAX_ROWS: Final = 4096
"""More rows of a track would not tell more."""
_BELOW: Final = 0.9


@dataclass(frozen=True, eq=False)
class Heights:
    """What was made of the heights of a log.

    datum    what they count from; None where none are used
    record   for the summary; empty as above
    remarks  what a user should know of it, a sentence each
    """

    datum: str | None = None
    record: Mapping[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def settle_heights(
    rows: Mapping[str, Positions], readers: Sequence[ChannelReader], is_used: bool
) -> tuple[dict[str, Positions], Heights]:
    """Detections with heights of one datum and their variances, truth with heights of the same; as they are without any."""
    detections, by_topic = rows["detections"], {reader.channel.topic: reader for reader in readers}
    is_stated = _is_stated(detections)
    if not is_used or not is_stated.any():
        return dict(rows), Heights()
    datum_of = {topic: str(by_topic[topic].vertical_datum) for topic in detections.topics.names}
    datum = _datum_of_rows(detections, datum_of)
    counts = Counter(datum[is_stated].tolist())
    chosen = counts.most_common(1)[0][0]
    kept = is_stated & (datum == chosen)
    height_m = np.where(kept, detections.z_m, np.nan)
    variance_m2, noises = _variances(detections, height_m, by_topic)
    covariance = detections.height_covariance_m2.copy()
    covariance[:, 2] = variance_m2
    found = {**rows, "detections": detections.changed(z_m=height_m, height_covariance_m2=covariance)}
    truth = rows["truth"]
    if len(truth):
        of_truth = _datum_of_rows(truth, {topic: str(by_topic[topic].vertical_datum) for topic in truth.topics.names})
        found["truth"] = truth.changed(z_m=np.where(_is_stated(truth) & (of_truth == chosen), truth.z_m, np.nan))
    record = {
        "vertical_datum": chosen, "num_detections": int(kept.sum()), "num_without": int((~kept).sum()),
        "noise": [_noise_record(*pair) for pair in noises.items()],
    }  # fmt: skip
    return found, Heights(chosen, record, tuple(_remarks(record, counts, height_m)))


def _is_stated(rows: Positions) -> Bools:
    """Which rows [N] have a height, as far as their topic has any that is not zero."""
    found = np.isfinite(rows.z_m)
    for topic_rows in rows.topics.rows():
        if not (rows.z_m[topic_rows][found[topic_rows]] != 0).any():
            found[topic_rows] = False
    return found


def _datum_of_rows(rows: Positions, datum_of: Mapping[str, str]) -> np.ndarray:
    return np.array([datum_of[topic] for topic in rows.topics.names], dtype=object)[rows.topics.number]


def _variances(
    rows: Positions, height_m: Float64s, by_topic: Mapping[str, ChannelReader]
) -> tuple[Float64s, dict[str, HeightNoise | None]]:
    """Variances [N] of heights: the user's, the message's, else by likelihood; and what that found, by source."""
    stated, covariance = rows.height_covariance_m2[:, 2].copy(), rows.covariance_m2
    with np.errstate(invalid="ignore"):
        is_guess = ~(stated > 0) | np.isclose(stated, (covariance[:, 0] + covariance[:, 2]) / 2)  # see `covariances._heights`
    variance = np.where(is_guess, np.nan, stated)
    for number, topic in enumerate(rows.topics.names):
        if (sigma_z_m := by_topic[topic].source.sigma_z_m) is not None:
            variance[rows.topics.number == number] = sigma_z_m**2
    sources: dict[str, list[int]] = {}
    for number, topic in enumerate(rows.topics.names):
        sources.setdefault(by_topic[topic].source.topic, []).append(number)
    noises: dict[str, HeightNoise | None] = {}
    for name, numbers in sources.items():
        of_source = np.isin(rows.topics.number, numbers)
        is_open = of_source & np.isnan(variance) & np.isfinite(height_m)
        if not is_open.any():
            continue
        noise = noises[name] = height_noise(_tracks(rows, height_m, of_source))
        if noise is not None and noise.is_sure:
            variance[is_open] = noise.sigma_m**2
        else:
            variance[is_open] = stated[is_open]
    return np.where(np.isfinite(height_m), variance, np.nan), noises


def _tracks(rows: Positions, height_m: Float64s, chosen: Bools) -> list[HeightTrack]:
    """Heights of a source by agent; rows without a name are no track."""
    found = []
    for of_agent in rows.agents.rows():
        some = of_agent[chosen[of_agent] & np.isfinite(height_m[of_agent])][:_MAX_ROWS]
        if len(some):
            time_s = (rows.time_ns[some] - rows.time_ns[some[0]]) * 1e-9
            found.append(HeightTrack(time_s, height_m[some], np.full(len(some), np.nan)))
    return found


def _noise_record(name: str, noise: HeightNoise | None) -> dict[str, Any]:
    if noise is None:
        return {"source": name}
    return {
        "source": name, "sigma_m": noise.sigma_m, "interval_m": list(noise.interval_m), "rounded_to_m": noise.rounded_to_m,
        "is_taken": noise.is_sure,
    }  # fmt: skip


def _remarks(record: Mapping[str, Any], counts: Mapping[str, int], height_m: Float64s) -> list[str]:
    found = [height_words(record)]
    chosen = record["vertical_datum"]
    for other, number in counts.items():
        if other != chosen:
            found.append(
                f"{number} heights count from another datum ({other}, those of most from {chosen}) and are not used; "
                "vertical_datum in a [[extract.detections]] says otherwise"
            )
    known = height_m[np.isfinite(height_m)]
    if chosen in ("frame", "start") and np.mean(known < 0) >= _BELOW:
        found.append(
            f"{np.mean(known < 0):.0%} of the heights are below zero ({known.min():.4g} to {known.max():.4g} m)".replace(
                "%", " %"
            )
            + '; if z points down, give the source frame_convention = "ned"'
        )
    return found
