"""KML 2.2 with Google's tracks: a folder an agent, a track a hypothesis with a time for each place, and regions."""

from collections.abc import Iterator
from xml.sax.saxutils import escape

import numpy as np

from cadence.arrays import Float64s
from pipeline.takeaway.answer import Answer, RegionAt, Track
from pipeline.takeaway.colors import colors, opacity
from pipeline.takeaway.degrees import DECIMALS, HEIGHT_DECIMALS, iso, pieces, region_in_degrees, rings
from pipeline.takeaway.thinned import thin_means, thin_tracks

_HEAD = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">\n<Document>\n'
)


def kml_text(answer: Answer, num_hypotheses: int) -> Iterator[str]:
    """The document, a placemark at a time."""
    hues = colors(answer.agent_ids)
    yield f"{_HEAD}<name>{escape(answer.name)}</name>\n"
    regions = list(answer.regions)
    tracks = thin_tracks(answer, num_hypotheses)
    heaviest = max((track.weight for track in tracks), default=1.0)
    means = thin_means(answer)
    for agent_id in answer.agent_ids:
        yield f"<Folder><name>{escape(agent_id)}</name>\n"
        for track in (each for each in (*tracks, *means) if each.agent_id == agent_id):
            alpha = 1.0 if track.hypothesis is None else opacity(track.weight, heaviest)
            for piece, place in pieces(answer.frame, track):
                yield _track(piece, place, _color(hues[agent_id], alpha), 3 if track.hypothesis is None else 1)
        for region in (each for each in regions if each.agent_id == agent_id):
            yield _region(answer, region, _color(hues[agent_id], 0.4 - 0.3 * region.level))
        yield "</Folder>\n"
    yield "</Document>\n</kml>\n"


def _track(track: Track, place: Float64s, color: str, width: int) -> str:
    height, mode = np.zeros(len(track)), "clampToGround"
    if track.height_m is not None and np.isfinite(track.height_m).all():
        height, mode = track.height_m, "absolute"
    when = "".join(f"<when>{iso(time_ns)}</when>" for time_ns in track.time_ns.tolist())
    where = "".join(
        f"<gx:coord>{lon:.{DECIMALS}f} {lat:.{DECIMALS}f} {up:.{HEIGHT_DECIMALS}f}</gx:coord>"
        for (lon, lat), up in zip(place.tolist(), height.tolist(), strict=True)
    )
    told = f"weight {track.weight:.6g}" if track.hypothesis is not None else "weighted mean of all hypotheses"
    return (
        f"<Placemark><name>{escape(track.name)}</name><description>{told}</description>"
        f"<Style><IconStyle><color>{color}</color><scale>0.4</scale></IconStyle><LabelStyle><scale>0</scale></LabelStyle>"
        f"<LineStyle><color>{color}</color><width>{width}</width></LineStyle></Style>"
        f"<gx:Track><altitudeMode>{mode}</altitudeMode>{when}{where}</gx:Track></Placemark>\n"
    )


def _region(answer: Answer, region: RegionAt, color: str) -> str:
    polygons = "".join(
        f"<Polygon><outerBoundaryIs>{_ring(outline)}</outerBoundaryIs>"
        + "".join(f"<innerBoundaryIs>{_ring(hole)}</innerBoundaryIs>" for hole in holes)
        + "</Polygon>"
        for outline, holes in rings(region_in_degrees(answer.frame, region.shape))
    )
    return (
        f"<Placemark><name>{escape(region.agent_id)} {region.level:.0%}</name>"
        f"<TimeSpan><begin>{iso(region.time_ns)}</begin><end>{iso(region.end_ns)}</end></TimeSpan>"
        f"<Style><LineStyle><width>0</width></LineStyle><PolyStyle><color>{color}</color></PolyStyle></Style>"
        f"<MultiGeometry>{polygons}</MultiGeometry></Placemark>\n"
    )


def _ring(points: Float64s) -> str:
    places = " ".join(f"{lon:.{DECIMALS}f},{lat:.{DECIMALS}f}" for lon, lat in points.tolist())
    return f"<LinearRing><coordinates>{places}</coordinates></LinearRing>"


def _color(rgb: tuple[int, int, int], alpha: float) -> str:
    """As KML has it: alpha, blue, green, red."""
    red, green, blue = rgb
    return f"{round(255 * alpha):02x}{blue:02x}{green:02x}{red:02x}"
