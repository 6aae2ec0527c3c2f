"""CZML, as Cesium plays it: a packet a track and a packet a region, each with the time in which it is there."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from cadence.arrays import Float64s
from pipeline.takeaway.answer import Answer, RegionAt, Track
from pipeline.takeaway.colors import colors, opacity
from pipeline.takeaway.degrees import HEIGHT_DECIMALS, iso, pieces, region_in_degrees, rings
from pipeline.takeaway.thinned import thin_means, thin_tracks

_SPEED = 60
_TRAIL_S = 600


def czml_text(answer: Answer, num_hypotheses: int) -> Iterator[str]:
    """The document, a packet at a time."""
    start_ns, end_ns = int(answer.stretches[0].time_ns[0]), int(answer.stretches[-1].time_ns[-1])
    clock = {"interval": f"{iso(start_ns)}/{iso(end_ns)}", "currentTime": iso(start_ns), "multiplier": _SPEED}
    yield "[\n" + json.dumps({"id": "document", "name": answer.name, "version": "1.0", "clock": clock}, ensure_ascii=False)
    for packet in _packets(answer, num_hypotheses):
        yield ",\n" + json.dumps(packet, separators=(",", ":"), ensure_ascii=False)
    yield "\n]\n"


def _packets(answer: Answer, num_hypotheses: int) -> Iterator[dict[str, Any]]:
    hues = colors(answer.agent_ids)
    tracks = thin_tracks(answer, num_hypotheses)
    heaviest = max((track.weight for track in tracks), default=1.0)
    numbers: dict[str, int] = {}
    for track in (*tracks, *thin_means(answer)):
        alpha = 1.0 if track.hypothesis is None else opacity(track.weight, heaviest)
        for piece, place in pieces(answer.frame, track):
            number = numbers[track.name] = numbers.get(track.name, 0) + 1
            yield _track(piece, place, f"{track.name} {number}", [*hues[track.agent_id], round(255 * alpha)])
    for index, region in enumerate(answer.regions):
        yield from _region(answer, region, index, [*hues[region.agent_id], round(255 * (0.4 - 0.3 * region.level))])


def _track(track: Track, place: Float64s, packet_id: str, rgba: list[int]) -> dict[str, Any]:
    height = np.zeros(len(track))
    if track.height_m is not None and np.isfinite(track.height_m).all():
        height = np.round(track.height_m, HEIGHT_DECIMALS)
    start_ns = int(track.time_ns[0])
    after_s = np.round((track.time_ns - start_ns) * 1e-9, 6)
    cells = np.column_stack([after_s, place, height]).ravel().tolist()
    color, width = {"rgba": rgba}, 3 if track.hypothesis is None else 1
    return {
        "id": packet_id,
        "name": track.name,
        "parent": track.agent_id,
        "description": "weighted mean" if track.hypothesis is None else f"weight {track.weight:.6g}",
        "availability": f"{iso(start_ns)}/{iso(int(track.time_ns[-1]))}",
        "position": {"epoch": iso(start_ns), "interpolationAlgorithm": "LINEAR", "cartographicDegrees": cells},
        "point": {"color": color, "pixelSize": 8 if track.hypothesis is None else 4},
        "path": {"material": {"solidColor": {"color": color}}, "width": width, "leadTime": 0, "trailTime": _TRAIL_S},
    }


def _region(answer: Answer, region: RegionAt, index: int, rgba: list[int]) -> Iterator[dict[str, Any]]:
    for part, (outline, holes) in enumerate(rings(region_in_degrees(answer.frame, region.shape))):
        polygon: dict[str, Any] = {
            "positions": {"cartographicDegrees": _flat(outline)},
            "material": {"solidColor": {"color": {"rgba": rgba}}},
            "height": 0,
        }
        if holes:
            polygon["holes"] = {"cartographicDegrees": [_flat(hole) for hole in holes]}
        yield {
            "id": f"region {index} {part}",
            "name": f"{region.agent_id} {region.level:.0%}",
            "availability": f"{iso(region.time_ns)}/{iso(max(region.end_ns, region.time_ns))}",
            "polygon": polygon,
        }


def _flat(points: Float64s) -> list[float]:
    """Longitude, latitude and height, one behind the other, without the last point, which is the first."""
    found: list[float] = np.column_stack([points[:-1], np.zeros(len(points) - 1)]).ravel().tolist()
    return found
