"""The section on silence: what was covered when, how surely sensors detect over distance, and how much of it is believed."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from cadence.arrays import Float64s
from cadence.evidence.footprints import detection_probability
from cadence.evidence.silence import Looks
from pipeline.clock import Clock
from pipeline.counted import counted
from pipeline.lengths import metres
from pipeline.looks import Footprint
from pipeline.report.maps import MAP_HEIGHT, MAP_WIDTH, View, north_arrow, scale_bar
from pipeline.report.markup import section, table, text
from pipeline.report.mission import Mission

NUM_PARTS = 4
_COLUMNS, _ROWS = 48, 36
_MOST_LOOKS = 600
"""Looks of a footprint that are drawn of a part: more of them, evenly left out, look the same."""
_CURVE_WIDTH, _CURVE_HEIGHT = 150, 46
_LEAST_SHOWN = 0.1
_NUM_SHADES = 8
_NUM_PIECES = 24
"""Of a quarter of the mission."""


def silence_section(mission: Mission) -> str:
    """Maps of the parts of the mission, a table of the footprints; nothing where the log's sensors are not stated."""
    if not mission.looks:
        return ""
    clock = Clock(mission.start_ns, mission.end_ns)
    edges_s = np.linspace(0.0, (mission.end_ns - mission.start_ns) * 1e-9, NUM_PARTS + 1)
    view = View(_places(mission))
    figures = []
    for first_s, last_s in zip(edges_s[:-1].tolist(), edges_s[1:].tolist(), strict=True):
        first_ns, last_ns = (mission.start_ns + round(second * 1e9) for second in (first_s, last_s))
        words = f"{clock.moment(first_ns)} to {clock.moment(last_ns)}"
        drawing = _coverage_map(mission, view, first_s, last_s, first_ns, last_ns, words)
        figures.append(f"<figure>{drawing}<figcaption>{text(words)}</figcaption></figure>")
    lead = (
        "Where sensors looked in each quarter of the mission: the darker, the more of the time a target there would have been "
        "detected. "
    )
    return section(
        "Where sensors looked", f'<div class="moments">{"".join(figures)}</div>{_table(mission)}', lead + _believed(mission)
    )


def _believed(mission: Mission) -> str:
    """How much of the silence counts, in words."""
    silence = ((mission.manifests.get("infer", {}).get("summary") or {}).get("silence")) or {}
    if not silence:
        return "None of it was used."
    exponent, num_tests = float(silence.get("exponent") or 0.0), int(silence.get("num_tests") or 0)
    ratio = (silence.get("ratios") or {}).get(f"{exponent:g}")
    stated = ((mission.manifests["infer"].get("config") or {}).get("evidence") or {}).get("exponent")
    if exponent == 0.0:
        why = "as is set (infer.evidence.exponent)"
        if stated is None:
            why = f"as hypotheses weighed by it miss {counted(num_tests, 'withheld detection')} by more than without it"
        return f"That a target was not detected there is not used, {why}."
    how, told = "as too few withheld detections can tell" if stated is None else "as is set", ""
    if ratio is not None:
        how = f"as {counted(num_tests, 'withheld detection')} advise{'s' if num_tests == 1 else ''}"
        told = f"; weighed by it, hypotheses miss them by {float(ratio):.2f} of what they did"
    return f"Hypotheses that were there unseen count less: by {exponent:g} of what independent looks would say, {how}{told}."


def _places(mission: Mission) -> Float64s:
    """What a map of the whole mission must hold: detections, and what sensors near them see."""
    places = [mission.detections.position_m, *(fan.datum_m[None] for fan in mission.fans)]
    if mission.poses is not None:
        places.append(mission.poses.position_m)
    found = np.concatenate(places) if sum(map(len, places)) else np.zeros((1, 2))
    return np.asarray(found[np.isfinite(found).all(axis=1)])


def coverage(looks: Sequence[tuple[Footprint, Looks]], places_m: Float64s, first_s: float, last_s: float) -> Float64s:
    """In how much of the time from `first_s` to `last_s` the looks would detect somebody at a place [N, 2]: [N], 0 to 1.

    The time is cut into pieces; in each counts the chance that any of its looks detects.
    """
    edges_s = np.linspace(first_s, last_s, _NUM_PIECES + 1)
    log_missed = np.zeros((len(places_m), _NUM_PIECES))
    for _, some in looks:
        chosen = np.flatnonzero((some.time_s >= first_s) & (some.time_s <= last_s))
        if not len(chosen):
            continue
        part = some[chosen[np.linspace(0, len(chosen) - 1, min(_MOST_LOOKS, len(chosen))).round().astype(int)]]
        ways = part.position_m, part.heading_rad, part.range_m
        missed = np.log1p(-np.minimum(detection_probability(part.curve, part.area, places_m[:, None], *ways), 0.98))
        piece = np.clip(np.searchsorted(edges_s, part.time_s, "right") - 1, 0, _NUM_PIECES - 1)
        for number in np.unique(piece).tolist():
            log_missed[:, number] += len(chosen) / len(part) * missed[:, piece == number].sum(axis=1)
    return np.asarray((1.0 - np.exp(log_missed)).mean(axis=1))


def _coverage_map(mission: Mission, view: View, first_s: float, last_s: float, first_ns: int, last_ns: int, label: str) -> str:
    width, height = MAP_WIDTH / _COLUMNS, MAP_HEIGHT / _ROWS
    column, row = np.meshgrid(np.arange(_COLUMNS), np.arange(_ROWS))
    pixels = np.stack([(column + 0.5) * width, (row + 0.5) * height], axis=-1)
    share = coverage(mission.looks, view.metres(pixels.reshape(-1, 2)), first_s, last_s).reshape(_ROWS, _COLUMNS)
    cells = []
    for number, line in enumerate(np.ceil(_NUM_SHADES * share - _LEAST_SHOWN).tolist()):
        begin = 0
        for shade, run in itertools.groupby(line):
            end = begin + len(list(run))
            if shade > 0:
                place = f'x="{begin * width:.1f}" y="{number * height:.1f}" width="{(end - begin) * width:.1f}"'
                cells.append(
                    f'<rect class="covered" {place} height="{height:.1f}" fill-opacity="{0.8 * shade / _NUM_SHADES:.2f}"/>'
                )
            begin = end
    detections = mission.detections.between(first_ns, last_ns)
    dots = [
        f'<circle class="detection" cx="{x:.1f}" cy="{y:.1f}" r="3"/>' for x, y in view.pixels(detections.position_m).tolist()
    ]
    opening = f'<svg class="map" viewBox="0 0 {MAP_WIDTH} {MAP_HEIGHT}" role="img" aria-label="Covered {text(label)}">'
    return f"{opening}{''.join([*cells, *dots, scale_bar(view.pixel_per_m), north_arrow()])}</svg>"


def _table(mission: Mission) -> str:
    """A row a footprint, alike ones together: its curve, what it rests on, how often it looked and detected."""
    groups: dict[Any, list[tuple[Footprint, Looks]]] = {}
    for footprint, some in mission.looks:
        groups.setdefault((footprint.curves, footprint.shape, footprint.trust, footprint.is_standing), []).append(
            (footprint, some)
        )
    rows = []
    for members in groups.values():
        footprint = members[0][0]
        names = list(dict.fromkeys(member.sensor for member, _ in members))
        hits = sum(bool(names_seen) for _, some in members for names_seen in some.seen)
        rests = (
            "stated" if footprint.num_looks is None else f"fitted on {footprint.num_looks:,} looks, {footprint.num_hits:,} hits"
        )
        trust = "" if footprint.trust == 1.0 else f", believed {footprint.trust:.2f}: it contradicts detections"
        shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        rows.append(
            (text(shown), _curve(footprint), text(rests + trust), f"{sum(len(some) for _, some in members):,}", f"{hits:,}")
        )
    return table(("sensor", "how surely it detects, by distance", "known by", "looks", "detections"), rows[:40], (3, 4))


def _curve(footprint: Footprint) -> str:
    """The chance of a detection as a small drawing; of a fitted one both halves."""
    curves = [footprint.curve(part) for part in range(len(footprint.curves))]
    reach = max(curve.reach for curve in curves)
    at = np.linspace(0.0, reach, 60)
    lines = []
    for curve in curves:
        points = " ".join(
            f"{_CURVE_WIDTH * x / reach:.1f},{_CURVE_HEIGHT * (1 - y) + 1:.1f}" for x, y in zip(at, curve(at), strict=True)
        )
        lines.append(f'<polyline class="past mean" fill="none" points="{points}"/>')
    words = f"falls from {100 * max(float(curve(at[:1])[0]) for curve in curves):.0f} % to nothing at {metres(reach)}"
    opening = f'<svg width="{_CURVE_WIDTH}" height="{_CURVE_HEIGHT + 2}" role="img" aria-label="{text(words)}">'
    return f"{opening}{''.join(lines)}</svg><br><small>{text(words)}</small>"
