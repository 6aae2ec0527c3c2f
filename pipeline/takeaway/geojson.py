"""GeoJSON (RFC 7946): tracks as lines with a time for each of their points, means, and regions at moments."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely

from cadence.arrays import Float64s
from pipeline.takeaway.answer import Answer, Track
from pipeline.takeaway.degrees import DECIMALS, HEIGHT_DECIMALS, iso, pieces, region_in_degrees
from pipeline.takeaway.thinned import thin_means, thin_tracks


def geojson_text(answer: Answer, num_hypotheses: int) -> Iterator[str]:
    """The document, a feature at a time."""
    yield '{"type":"FeatureCollection","features":[\n'
    mark = ""
    for feature in _features(answer, num_hypotheses):
        yield mark + json.dumps(feature, separators=(",", ":"), ensure_ascii=False)
        mark = ",\n"
    yield "\n]}\n"


def _features(answer: Answer, num_hypotheses: int) -> Iterator[dict[str, Any]]:
    for region in answer.regions:
        shape = region_in_degrees(answer.frame, region.shape)
        properties = {"agent": region.agent_id, "kind": "region", "level": region.level, "time": iso(region.time_ns)}
        if region.window is not None:
            properties["window"] = region.window
        geometry = json.loads(shapely.to_geojson(shapely.set_precision(shape, 10.0**-DECIMALS)))
        yield {"type": "Feature", "properties": properties, "geometry": geometry}
    for track in (*thin_tracks(answer, num_hypotheses), *thin_means(answer)):
        for piece, place in pieces(answer.frame, track):
            yield {"type": "Feature", "properties": _properties(piece), "geometry": _line(place, piece.height_m)}


def _properties(track: Track) -> dict[str, Any]:
    found: dict[str, Any] = {"agent": track.agent_id, "kind": "mean" if track.hypothesis is None else "hypothesis"}
    if track.hypothesis is not None:
        found |= {"hypothesis": track.hypothesis, "weight": track.weight}
    if track.window is not None:
        found["window"] = track.window
    if track.spread_m is not None:
        found["spread_m"] = np.round(track.spread_m, 2).tolist()
    return found | {"times": [iso(time_ns) for time_ns in track.time_ns.tolist()]}


def _line(place: Float64s, height_m: Float64s | None) -> dict[str, Any]:
    points = place.tolist()
    if height_m is not None and np.isfinite(height_m).all():
        points = np.column_stack([place, np.round(height_m, HEIGHT_DECIMALS)]).tolist()
    return {"type": "Point", "coordinates": points[0]} if len(points) == 1 else {"type": "LineString", "coordinates": points}
