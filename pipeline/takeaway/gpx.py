"""GPX 1.1: a track a hypothesis and a track a mean; GPX knows no regions."""

from collections.abc import Iterator
from xml.sax.saxutils import escape

import numpy as np

from cadence.arrays import Float64s
from pipeline.takeaway.answer import Answer, Track
from pipeline.takeaway.degrees import DECIMALS, HEIGHT_DECIMALS, coordinates, iso
from pipeline.takeaway.thinned import thin_means, thin_tracks


def gpx_text(answer: Answer, num_hypotheses: int) -> Iterator[str]:
    """The document, a track at a time: means first, as most devices show the first ones."""
    yield '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="CADENCE" xmlns="http://www.topografix.com/GPX/1/1">\n'
    yield f"<metadata><name>{escape(answer.name)}</name></metadata>\n"
    for track in (*thin_means(answer), *thin_tracks(answer, num_hypotheses)):
        yield _track(track, coordinates(answer.frame, track.position_m))
    yield "</gpx>\n"


def _track(track: Track, place: Float64s) -> str:
    known = track.height_m is not None and bool(np.isfinite(track.height_m).all())
    heights = (
        [f"<ele>{height:.{HEIGHT_DECIMALS}f}</ele>" for height in track.height_m.tolist()]
        if known and track.height_m is not None
        else [""] * len(track)
    )
    points = "".join(
        f'<trkpt lat="{lat:.{DECIMALS}f}" lon="{lon:.{DECIMALS}f}">{height}<time>{iso(time_ns)}</time></trkpt>'
        for (lon, lat), height, time_ns in zip(place.tolist(), heights, track.time_ns.tolist(), strict=True)
    )
    kind = "mean" if track.hypothesis is None else "hypothesis"
    told = "weighted mean of all hypotheses" if track.hypothesis is None else f"weight {track.weight:.6g}"
    return f"<trk><name>{escape(track.name)}</name><desc>{told}</desc><type>{kind}</type><trkseg>{points}</trkseg></trk>\n"
