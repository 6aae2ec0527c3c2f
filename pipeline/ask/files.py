"""What `where` leaves for other programs: areas as GeoJSON, the POA grid as GeoTIFF, and a map to look at."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.figure import Figure
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from cadence.answers.whereabouts import Grid
from cadence.arrays import Float64s
from pipeline.ask.answers import Answer
from pipeline.ask.known import Known
from pipeline.files import replacing, write_atomic
from pipeline.frames import to_geodetic
from pipeline.tables import Frame

_PIXEL_SCALE, _TIEPOINT, _GEO_KEYS, _GEO_DOUBLES = 33550, 33922, 34735, 34736
_MODEL_TYPE, _RASTER_TYPE, _GEOGRAPHIC_TYPE, _PROJECTED_TYPE = 1024, 1025, 2048, 3072
_PROJECTION, _TRANSFORMATION, _UNITS, _CENTRE_LONGITUDE, _CENTRE_LATITUDE = 3074, 3075, 3076, 3088, 3089
_USER_DEFINED, _WGS84, _AZIMUTHAL_EQUIDISTANT, _METRE = 32767, 4326, 12, 9001
_NUM_LINES = 40
_DPI = 120


def write_places(known: Known, found: Sequence[Answer], directory: Path) -> tuple[Path, ...]:
    """Write NAME.geojson and NAME.tif for each answer to `where`, and where.png with all of them; their paths.

    GeoJSON is in longitude and latitude, or in metres of the mission frame where the log is not georeferenced. Raises
    `DeviceError` where the folder cannot be written to.
    """
    paths = []
    for answer in found:
        if answer.place is not None:
            stem = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in f"where_{answer.agents[0]}")
            geojson, tiff = directory / f"{stem}.geojson", directory / f"{stem}.tif"
            directory.mkdir(parents=True, exist_ok=True)
            write_atomic(geojson, json.dumps(areas_geojson(answer, known.frame), allow_nan=False) + "\n")
            with replacing(tiff) as draft:
                write_geotiff(answer.place.grid, known.frame, draft)
            paths += [geojson, tiff]
    if paths:
        with replacing(directory / "where.png") as draft:
            draw_map(known, found, draft)
        paths.append(directory / "where.png")
    return tuple(paths)


def areas_geojson(answer: Answer, frame: Frame) -> dict[str, Any]:
    """The areas as a FeatureCollection, the largest first, so that smaller ones are drawn on top."""
    assert answer.place is not None
    features = [
        {
            "type": "Feature",
            "properties": {
                "agent": answer.agents[0], "level": area.level, "area_km2": area.area_m2 / 1e6, "at_ns": answer.start_ns,
            },
            "geometry": shapely.geometry.mapping(_geodetic(area.shape, frame)),
        }
        for area in reversed(answer.place.areas)
    ]  # fmt: skip
    return {"type": "FeatureCollection", "features": features}


def write_geotiff(grid: Grid, frame: Frame, path: Path) -> None:
    """The grid as one float32 band, north up, cells that sum to one, in the mission's own projection if it has one."""
    num_rows = grid.probability.shape[0]
    tags = ImageFileDirectory_v2()
    tags[_PIXEL_SCALE] = (grid.cell_m, grid.cell_m, 0.0)
    tags[_TIEPOINT] = (0.0, 0.0, 0.0, grid.west_m, grid.south_m + num_rows * grid.cell_m, 0.0)
    tags.tagtype[_PIXEL_SCALE] = tags.tagtype[_TIEPOINT] = tags.tagtype[_GEO_DOUBLES] = 12  # double
    tags.tagtype[_GEO_KEYS] = 3  # short
    keys = {_MODEL_TYPE: (0, _USER_DEFINED), _RASTER_TYPE: (0, 1)}
    if frame.latitude_deg is not None and frame.longitude_deg is not None:
        tags[_GEO_DOUBLES] = (frame.longitude_deg, frame.latitude_deg)
        keys = {
            _MODEL_TYPE: (0, 1), _RASTER_TYPE: (0, 1), _GEOGRAPHIC_TYPE: (0, _WGS84), _PROJECTED_TYPE: (0, _USER_DEFINED),
            _PROJECTION: (0, _USER_DEFINED), _TRANSFORMATION: (0, _AZIMUTHAL_EQUIDISTANT), _UNITS: (0, _METRE),
            _CENTRE_LONGITUDE: (_GEO_DOUBLES, 0), _CENTRE_LATITUDE: (_GEO_DOUBLES, 1),
        }  # fmt: skip
    entries = [value for key, (place, at) in keys.items() for value in (key, place, 1, at)]
    tags[_GEO_KEYS] = (1, 1, 0, len(keys), *entries)
    Image.fromarray(grid.probability[::-1].astype(np.float32)).save(
        path, format="TIFF", tiffinfo=tags, compression="tiff_adobe_deflate"
    )


def draw_map(known: Known, found: Sequence[Answer], path: Path) -> None:
    """Areas of all answers, with some of the stories around the moment, north up, in kilometres."""
    figure = Figure(figsize=(7.0, 7.0), dpi=_DPI, layout="constrained")
    axes = figure.subplots()
    placed = [answer for answer in found if answer.place is not None]
    for number, answer in enumerate(placed):
        assert answer.place is not None
        colour = f"C{number % 10}"
        for area, opacity in zip(reversed(answer.place.areas), (0.15, 0.25, 0.45), strict=True):
            for part in shapely.get_parts(area.shape):
                x, y = np.asarray(part.exterior.coords).T / 1000.0
                axes.fill(x, y, color=colour, alpha=opacity, linewidth=0.0)
        for x, y in _tracks(known, answer):
            axes.plot(x, y, color=colour, alpha=0.15, linewidth=0.6, zorder=1)
        x_m, y_m = answer.place.centre_m
        axes.plot(x_m / 1000.0, y_m / 1000.0, "o", color=colour, markersize=3.0, label=answer.agents[0])
    bounds = np.array([answer.place.areas[-1].shape.bounds for answer in placed if answer.place is not None]) / 1000.0
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    middle, half = 0.5 * (low + high), 0.75 * max(float((high - low).max()), 1e-3)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
    axes.set_xlabel("km east")
    axes.set_ylabel("km north")
    axes.set_title(f"{known.clock.moment(placed[0].start_ns)}: areas of 50, 90 and 95 %", fontsize=10)
    if len(placed) <= 12:
        axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, format="png")


def _tracks(known: Known, answer: Answer) -> list[tuple[Float64s, Float64s]]:
    """Some stories of an agent, in kilometres."""
    agent = known.stories.agent_ids.index(answer.agents[0])
    tracks = known.stories.position_m[:_NUM_LINES, agent] / 1000.0
    return [(track[:, 0], track[:, 1]) for track in tracks]


def _geodetic(shape: Any, frame: Frame) -> Any:
    """The shape in longitude and latitude; unchanged where the frame is not georeferenced."""
    if not frame.is_georeferenced:
        return shape

    def placed(points: Float64s) -> Float64s:
        latitude, longitude = to_geodetic(frame, points[:, 0].copy(), points[:, 1].copy())
        return np.stack([longitude, latitude], axis=1)

    return shapely.transform(shape, placed)
