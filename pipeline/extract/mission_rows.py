"""Positions as read → the rows of every role, in the mission frame, as far as they can be meant."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Final

import numpy as np

from cadence.errors import InputError, NothingDetectedError
from pipeline.counted import counted
from pipeline.extract.bearing_check import without_contradicted
from pipeline.extract.cameras import read_cameras
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.config import ExtractConfig
from pipeline.extract.fill_ins import without_fill_ins
from pipeline.extract.height_units import heights_in_metres
from pipeline.extract.hemispheres import check_hemispheres
from pipeline.extract.joined import check_joined
from pipeline.extract.mission_clock import on_one_clock
from pipeline.extract.names import Naming, in_one_spelling, without_false_names
from pipeline.extract.observers import from_observer
from pipeline.extract.origins import about_one_origin
from pipeline.extract.own_zeros import check_far_zeros, check_own_zeros
from pipeline.extract.placement import Placing, bring_together, datum_of_transforms, in_enu, mission_frame, place
from pipeline.extract.positions import Positions, Rows
from pipeline.extract.reuse import reused, without_reused_names
from pipeline.extract.selection import ROLES
from pipeline.extract.sightings import SIGHTINGS, Sightings, in_pairs, read_parts, together, without_names
from pipeline.extract.spikes import is_spike
from pipeline.extract.stages import without_other_stages
from pipeline.extract.stretches import without_set_back, without_unjoined
from pipeline.extract.thinning import ThinningConfig, is_seen, noise
from pipeline.extract.transform_messages import LogTransforms
from pipeline.extract.transforms import Limits
from pipeline.extract.units import in_true_units
from pipeline.extract.unmeasured import check_wrapped, with_rounding, without_frozen, without_held
from pipeline.extract.writing_order import without_set_back_unnumbered
from pipeline.logs.health import utc
from pipeline.logs.reader import MissionLog
from pipeline.suspicions import Suspicions, few
from pipeline.tables import Frame

_MAX_FAR_M: Final = 1e9
"""Beyond the moon; squares of much larger numbers overflow further on."""
_YEAR_S: Final = 365.25 * 86400
_MAX_YEARS: Final = 100.0
"""Nobody records a mission for longer; windows of centuries reach beyond the times that files can state."""

Parts = dict[str, list[tuple[ChannelReader, Positions]]]


def rows_in_frame(
    log: MissionLog, readers: Sequence[ChannelReader], config: ExtractConfig, counts: Counter[str], suspicions: Suspicions,
    transforms: LogTransforms,
) -> tuple[dict[str, Positions], Frame]:  # fmt: skip
    """The rows of every role, placed in the mission frame and thinned, and that frame."""
    parts: Parts = {role: [(reader, reader.finish()) for reader in readers if reader.role == role] for role in ROLES[1:]}
    detecting = [reader for reader in readers if reader.role == "detections"]
    detections, sightings = read_parts(detecting, read_cameras(log, detecting), counts, suspicions)
    parts = {"detections": detections, **parts} | ({SIGHTINGS: sightings} if sightings else {})
    check_own_zeros(parts, suspicions)
    parts, origin = about_one_origin(parts)
    parts = without_set_back(parts, suspicions)
    if counts["steps_back"] and config.start is None and config.end is None:
        parts = without_set_back_unnumbered(parts, log, suspicions)
    parts = {role: _numbered(found) for role, found in parts.items()}
    timed, clock = on_one_clock(parts, suspicions)
    limits = Limits(config.max_extrapolation_s, config.max_transform_gap_s)
    timed = _from_observers(parts, timed, limits, counts, suspicions)
    placed = {role: _in_place(role, parts[role], timed[role], counts, suspicions) for role in ROLES}
    check_hemispheres(placed, config.datum, suspicions)
    rows = {role: _columns([each for _, each in placed[role]], counts) for role in ROLES}
    if sightings:
        rows[SIGHTINGS] = timed[SIGHTINGS][0]
    primary = "truth" if config.thinning.enabled and config.thinning.thin_from == "truth" else "detections"
    if sightings and primary == "detections":
        _check_drawable(rows, suspicions)
    _check_any(primary, rows[primary], counts, suspicions)
    rows = without_unjoined(rows, primary, suspicions)
    _check_span(primary, rows[primary])
    placing = Placing(config.frame, limits)
    read_tree = partial(transforms.read, clock)
    if config.frame is None:
        framed = {r.channel.topic for r in readers if "frame_id" in r.fields and r.fields["frame_id"].is_found}
        check_joined(rows, primary, transforms, read_tree, log, suspicions, framed)
    rows = bring_together(rows, primary, placing, read_tree, counts)
    _check_any(primary, rows[primary], counts, suspicions)
    are_enu = {reader.channel.topic for reader in readers if reader.source.frame_convention == "enu"}
    rows = {role: in_enu(positions, are_enu, counts) for role, positions in rows.items()}
    check_far_zeros(rows["detections"], suspicions)
    datum = config.datum or datum_of_transforms(rows[primary], read_tree)
    if datum is None and any(positions.is_geodetic.any() for positions in rows.values()):
        datum = origin
    frame = mission_frame(rows[primary], [rows[role] for role in ROLES if role != primary], datum)
    rows = {role: _placed(role, found, frame, counts, transforms.apart) for role, found in rows.items()}
    before = set(rows["detections"].agents.names)
    rows["detections"] = _identified(rows["detections"], readers, config.simultaneity_s, suspicions)
    if isinstance(found := rows.get(SIGHTINGS), Sightings):
        lost = before - set(rows["detections"].agents.names)
        found = without_names(found, lost | reused(rows["detections"].agents.names))
        rows[SIGHTINGS] = without_contradicted(found, rows["detections"], suspicions)
    rows |= {role: _without_spikes(rows[role], config.max_speed_mps, counts) for role in ROLES}
    if config.thinning.enabled:
        rows["detections"] = _thinned(rows[primary], config.thinning)
        if len(rows["detections"]) == 0:
            raise InputError("thinning left no detection; choose a smaller extract.thinning.mean_gap_s or another seed")
    return rows, frame


def _from_observers(
    parts: Parts, timed: dict[str, list[Positions]], limits: Limits, counts: Counter[str], suspicions: Suspicions
) -> dict[str, list[Positions]]:
    """The rows of every reader by role, those about an observer at its places; sightings all together, in pairs."""
    found = dict(timed)
    measuring = [role for role in ("detections", SIGHTINGS) if role in parts]
    if SIGHTINGS in parts:
        found[SIGHTINGS] = [in_pairs(rows) for rows in timed[SIGHTINGS]]
    if any(reader.has_observer for role in measuring for reader, _ in parts[role]):
        about = [each for _, each in _in_place("poses", parts["poses"], timed["poses"], Counter(), suspicions)]
        poses = Positions.concatenate(about or [Rows().finish()])
        for role in measuring:
            found[role] = [
                from_observer(reader, each, poses, limits, counts) if reader.has_observer else each
                for (reader, _), each in zip(parts[role], found[role], strict=True)
            ]
    if SIGHTINGS in parts:
        found[SIGHTINGS] = [together(found[SIGHTINGS])]
    return found


def _identified(rows: Positions, readers: Sequence[ChannelReader], tolerance_s: float, suspicions: Suspicions) -> Positions:
    """Detections, each counted once, with names that can be meant."""
    of_detections = [reader for reader in readers if reader.role == "detections"]
    naming = Naming(
        believed={reader.channel.topic for reader in of_detections if reader.source.has_identity},
        topical={reader.channel.topic for reader in of_detections if reader.names["agent"] is not None},
        stated={reader.channel.topic for reader in of_detections if reader.is_stated and reader.source.agent_path is not None},
    )
    rows = in_one_spelling(rows)
    suggested = {reader.channel.topic: reader.channel.schema_name for reader in of_detections if not reader.is_stated}
    rows = without_false_names(rows, tolerance_s, naming, suspicions)
    rows = without_other_stages(rows, suggested, suspicions)
    return without_reused_names(rows, tolerance_s, naming, suspicions)


def _columns(parts: Sequence[Positions], counts: Counter[str]) -> Positions:
    """All finite rows of a role, sorted by time."""
    counts["out_of_order"] += sum(int((part.time_ns < np.maximum.accumulate(part.time_ns)).sum()) for part in parts)
    rows = Positions.concatenate(list(parts) or [Rows().finish()])
    is_finite = np.isfinite(rows.first) & np.isfinite(rows.second)
    # A latitude off the earth, AIS's longitude for none, or metres beyond the moon, are as little a position as NaN.
    is_finite &= ~rows.is_geodetic | ((np.abs(rows.first) <= 90) & (np.abs(rows.second) <= 360) & (rows.second != 181))
    is_finite &= rows.is_geodetic | (np.maximum(np.abs(rows.first), np.abs(rows.second)) <= _MAX_FAR_M)
    counts["dropped_nonfinite"] += int((~is_finite).sum())
    rows = rows[is_finite]
    return rows[np.argsort(rows.time_ns, kind="stable")]


def _numbered(parts: Sequence[tuple[ChannelReader, Positions]]) -> list[tuple[ChannelReader, Positions]]:
    """The rows of each reader, with numbers of messages that no other reader has."""
    sizes = [int(part.message.max(initial=0)) for _, part in parts]
    return [
        (reader, part.changed(message=part.message + before))
        for (reader, part), before in zip(parts, itertools.accumulate(sizes, initial=0), strict=False)
    ]


def _in_place(
    role: str, parts: Sequence[tuple[ChannelReader, Positions]], timed: Sequence[Positions], counts: Counter[str],
    suspicions: Suspicions,
) -> list[tuple[ChannelReader, Positions]]:  # fmt: skip
    """The rows of each reader, whose times are mended, in true units and without fill-ins."""
    found = [
        (reader, in_true_units(reader.source, role, rows, suspicions)) for (reader, _), rows in zip(parts, timed, strict=True)
    ]
    found = [(reader, heights_in_metres(reader.source, role, rows, counts, suspicions)) for reader, rows in found]
    found = [(reader, without_held(without_fill_ins(rows, role, suspicions), role, suspicions)) for reader, rows in found]
    filled = [(reader, without_frozen(rows, role, suspicions)) for reader, rows in found]
    for _, rows in filled:
        check_wrapped(rows, role, suspicions)
    return [(reader, with_rounding(rows, role, reader.source.sigma_m is not None, suspicions)) for reader, rows in filled]


def _check_any(role: str, rows: Positions, counts: Counter[str], suspicions: Suspicions) -> None:
    if len(rows):
        return
    if suspicions:
        reason = f"nothing that can be meant is left of the {role}: {'; '.join(few(suspicions.lines()))}"
    elif counts["static"]:
        raise NothingDetectedError(
            f"all {counts['static']} returns stand, by the Doppler of their scans; is_static_used = true in the "
            "[[extract.detections]] of the radar uses them"
        )
    elif counts["no_transform"]:
        reason = (
            f"for none of the {role} the log has a transform near enough in time; "
            "raise extract.max_extrapolation_s and extract.max_transform_gap_s, or check the stamps"
        )
    elif counts["no_observer"]:
        reason = (
            f"for none of the {role} the log has a pose of their observer near enough in time; "
            "raise extract.max_extrapolation_s and extract.max_transform_gap_s, or check the stamps"
        )
    elif counts["text"] and counts["text"] == counts["dropped_nonfinite"]:
        reason = (
            "every position is text that is no number, as with a decimal comma, or degrees, minutes and seconds; let the "
            "recorder write numbers, or bring the positions in as a table with cadence import"
        )
    elif counts["dropped_nonfinite"]:
        reason = "every position is NaN, infinite or off the earth; check the recorder, or map another topic"
    elif counts["undecodable"]:
        reason = "no message of the mapped topics can be decoded; map another topic (cadence info lists them)"
    elif counts["unmet"]:
        reason = "no position meets the conditions of `where`; correct the [extract] entries"
    elif counts["no_fix"]:
        reason = (
            "every position is marked as none (no fix, or what is no target, as a list that is drawn); map another topic "
            "(cadence info lists them)"
        )
    elif counts["incomplete"]:
        reason = "no message of the mapped topics has a position where the mapping looks for it; correct the [extract] entries"
    elif counts["outside_time_cut"]:
        raise NothingDetectedError("no message of the mapped topics lies inside extract.start and extract.end; widen them")
    else:
        raise NothingDetectedError(f"the topics mapped as {role} hold no position; map another topic (cadence info lists them)")
    raise InputError(reason)


def _check_drawable(rows: Mapping[str, Positions], suspicions: Suspicions) -> None:
    """`InputError` where nothing but bearings, or ranges, tells of anybody."""
    num = len(rows[SIGHTINGS]) // rows[SIGHTINGS].PLACES
    if num and not len(rows["detections"]):
        doubted = f"; suspected {'; '.join(few(suspicions.lines()))}" if suspicions else ""
        raise InputError(
            f"{counted(num, 'measurement is', 'measurements are')} bearings or ranges alone, and no detection is a position: "
            f"from those alone no agent can be drawn yet; add a source of positions, or of ranges with bearings{doubted}"
        )


def _check_span(role: str, rows: Positions) -> None:
    """`InputError` where sorted rows span more time than any mission."""
    years = float(rows.time_ns[-1] - rows.time_ns[0]) * 1e-9 / _YEAR_S
    if years > _MAX_YEARS:
        raise InputError(
            f"the {role} span {years:.0f} years, by {utc(int(rows.time_ns[0]))} to {utc(int(rows.time_ns[-1]))}; choose a part "
            "with extract.start and extract.end, or state where their time is with time in their [extract] entries"
        )


def _placed(role: str, rows: Positions, frame: Frame, counts: Counter[str], apart: set[str]) -> Positions:
    """Rows in the mission frame. What the user asked for must fit; what was only suggested is left out and counted.

    The frames of what is left out are added to `apart`.
    """
    placed, num_elsewhere = place(rows, frame)
    if num_elsewhere:
        geodetic = {"latitude and longitude"} if (rows.is_geodetic & (not frame.is_georeferenced)).any() else set()
        apart |= geodetic | {str(name) for name in rows.frame_id[~rows.is_geodetic]} - {frame.frame_id, ""}
    if num_elsewhere and rows.is_stated.any():
        role = "detections" if role == SIGHTINGS else role
        found = counted(num_elsewhere, "position is", "positions are")
        raise InputError(
            f"{role}: {found} not in the mission frame {frame.frame_id!r}, and no transform of the log "
            f"joins them; take those topics out of [[extract.{role}]]"
        )
    counts["other_frame"] += num_elsewhere
    return placed


def _without_spikes(rows: Positions, max_speed_mps: float | None, counts: Counter[str]) -> Positions:
    if max_speed_mps is None:
        return rows
    spikes = is_spike(rows, max_speed_mps)
    counts["spikes"] += int(spikes.sum())
    return rows[~spikes]


def _thinned(rows: Positions, config: ThinningConfig) -> Positions:
    """The rows that fall into bursts, with noise."""
    if any(agent is None for agent in rows.agent):
        raise InputError(
            "thinning: some detections have no agent; give agent or agent_path, or set extract.thinning.enabled=false"
        )
    is_kept = np.zeros(len(rows), dtype=np.bool_)
    first, second = rows.first.copy(), rows.second.copy()
    for agent in sorted(set(rows.agent)):
        of_agent = np.flatnonzero(rows.agent == agent)
        is_kept[of_agent] = is_seen(rows.time_ns[of_agent], agent, config)
        if config.noise_m > 0:
            added = noise(len(of_agent), agent, config)
            first[of_agent] += added[:, 0]
            second[of_agent] += added[:, 1]
    covariance = rows.covariance_m2
    if config.variance_m2 > 0:
        covariance = np.nan_to_num(covariance, nan=0.0) + np.array([config.variance_m2, 0.0, config.variance_m2])
    return rows.changed(first=first, second=second, covariance_m2=covariance)[is_kept]
