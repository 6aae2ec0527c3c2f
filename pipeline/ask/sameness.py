"""Whether two detections or two tracks are one target, in words, with what would change if they were."""

from typing import Any

import numpy as np
import pyarrow as pa

from cadence.answers.estimates import Probability
from cadence.answers.sameness import SameTracks, same_detections, same_tracks
from cadence.errors import UsageError
from pipeline.ask.known import Known
from pipeline.ask.words import numbers, percent, span_words
from pipeline.clock import duration
from pipeline.lengths import metres, speed
from pipeline.manifest import read_manifest
from pipeline.tables import read_table
from pipeline.tracks import track_of

_CLUTTER_SHARE = 0.01
_SIGMAS = 6.0
"""Two tracks are taken for apart at this many standard deviations of their detections, where nothing else is stated."""


def same(known: Known, one: str, other: str, within_m: float | None) -> tuple[str, Probability | None, dict[str, Any]]:
    """Sentence without its full stop, probability of being one (None: only what speaks against it is known), and numbers."""
    if one.startswith("#") and other.startswith("#"):
        return _detections(known, one, other)
    if one.startswith("#") or other.startswith("#"):
        raise UsageError("same is about two detections (#N #M, rows of detections.parquet) or two agents, not one of each")
    tolerance_m = within_m or _tolerance_m(known, one, other)
    found = same_tracks(known.stories, known.agent(one), known.agent(other), tolerance_m)
    told = {"apart": numbers(found.apart), "tolerance_m": tolerance_m, "overlap_s": found.overlap_s}
    told |= {key: numbers(getattr(found, key)) for key in ("gap_s", "speed_mps", "usual_mps", "as_fast")}
    return _track_words(one, other, found), _opposite(found.apart) if found.gap_s is None else None, told


def _track_words(one: str, other: str, found: SameTracks) -> str:
    if found.gap_s is None or found.speed_mps is None or found.usual_mps is None or found.as_fast is None:
        return (
            f"{one} and {other} are there together for {duration(found.overlap_s)}, and further apart than "
            f"{metres(found.tolerance_m)} at one time: {percent(found.apart)}; then they are two"
        )
    needed, usual = found.speed_mps, found.usual_mps
    return (
        f"{one} and {other} are never there together, so that nothing says they are two: one target would have been unseen for "
        f"{span_words(found.gap_s)} and have gone {speed(needed.median)} ({speed(needed.low)} to {speed(needed.high)}) in the "
        f"mean, where the two go up to {speed(usual.median)} over as long a time; as fast or faster: {percent(found.as_fast)}; "
        "were they one, there would be one agent less, with one gap more"
    )


def _opposite(found: Probability) -> Probability:
    return Probability(1.0 - found.value, 1.0 - found.high, 1.0 - found.low, found.num_effective)


def _detections(known: Known, one: str, other: str) -> tuple[str, Probability | None, dict[str, Any]]:
    table, _ = read_table(known.directory / "detections.parquet", "detections")
    rows = [_row(text, table.num_rows) for text in (one, other)]
    chosen = table.take(pa.array(rows))
    names = chosen["agent_id"].to_pylist()
    if None not in names:
        said = f"of one agent, {names[0]}" if names[0] == names[1] else f"of two agents, {names[0]} and {names[1]}"
        return f"the log itself says that detections {one} and {other} are {said}", None, {"stated": names}
    track = track_of(chosen, 0.0)
    time_s = (track.time_ns - known.start_ns).astype(np.float64) * 1e-9
    covariance = track.covariance_m2 + _floor_m(known) ** 2 * np.eye(2)
    found = same_detections(known.stories, time_s, track.position_m, covariance, _clutter_density(known, table))
    asked = Probability(found.value, found.low, found.high, found.num_effective)
    (first, first_share), (second, second_share) = found.likeliest
    words = (
        f"detections {one} and {other} are of one agent: {percent(asked)}; the first is likeliest of {first} "
        f"({100 * first_share:.0f} %), the second of {second} ({100 * second_share:.0f} %)"
    )
    return words, asked, {"likeliest": [[first, first_share], [second, second_share]], "same": numbers(asked)}


def _row(text: str, num_rows: int) -> int:
    number = text.removeprefix("#")
    if not number.isdigit() or int(number) >= num_rows:
        raise UsageError(f"{text}: no row of detections.parquet; they are #0 to #{num_rows - 1}")
    return int(number)


def _floor_m(known: Known) -> float:
    """Accuracy that detections without a stated one are given at least: stories are stored to float32."""
    return max(0.01, 1e-4 * float(np.nanstd(known.stories.position_m[0])))


def _clutter_density(known: Known, table: pa.Table) -> float:
    """Of detections that nobody caused, for each that an agent caused, per square metre of where agents were."""
    manifest = read_manifest("infer", known.directory) or {}
    stated = ((manifest.get("config") or {}).get("association") or {}).get("clutter_share")
    share = float(stated) if stated else _CLUTTER_SHARE
    seen = np.stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()], axis=-1)
    everywhere = np.concatenate([seen, known.stories.position_m[0].reshape(-1, 2)])
    width_m, height_m = np.nanmax(everywhere, axis=0) - np.nanmin(everywhere, axis=0)
    longer_m = max(float(width_m), float(height_m), 1.0)
    return share / max(float(width_m * height_m), 0.01 * longer_m**2)  # who goes along a line could be beside it


def _tolerance_m(known: Known, one: str, other: str) -> float:
    """Six standard deviations of the two agents' detections, in the median; at least a metre."""
    table, _ = read_table(known.directory / "detections.parquet", "detections")
    names = np.array(table["agent_id"].to_pylist(), dtype=object)
    chosen = table.filter(pa.array((names == one) | (names == other))) if len(names) else table
    track = track_of(chosen if chosen.num_rows else table, 0.0)
    sigma_m = np.linalg.det(track.covariance_m2) ** 0.25
    return max(1.0, _SIGMAS * float(np.median(sigma_m))) if len(sigma_m) else 1.0
