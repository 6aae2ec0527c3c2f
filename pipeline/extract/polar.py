"""Ranges and bearings of a sensor → positions about it, with the covariance that they have (`cadence.measurement.polar`).

The axes are those of the sensor's frame, which transforms bring into the mission's; of a source that says where its observer
was, east and north about that place (`observers`).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s
from cadence.errors import ConfigError
from cadence.measurement.polar import cartesian
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.positions import Positions
from pipeline.suspicions import Suspicions

_LITTLE_MORE: Final = 1.01
"""Angles that are counted on over a full turn by a rounding are no degrees."""
_MOST_SIGMA_RAD: Final = 0.35
"""Beyond 20 degrees a beam tells a side of the sensor and no position."""


@dataclass(frozen=True, eq=False)
class Measured:
    """What one source measured [N]: metres, radians from x towards y and from there towards z, and standard deviations.

    NaN stands for what cannot be meant. Of a source without elevations these are zero, as are their sigmas.
    """

    range_m: Float64s
    bearing_rad: Float64s
    elevation_rad: Float64s
    range_sigma_m: Float64s
    bearing_sigma_rad: Float64s
    elevation_sigma_rad: Float64s
    has_elevation: bool


def read_rows(reader: ChannelReader, suspicions: Suspicions) -> Positions:
    """All rows of a reader as positions, in its frame or about its observer; what it states as positions as it is."""
    rows = reader.finish()
    if not reader.is_polar or not len(rows):
        return rows
    found = measured(reader, rows, suspicions)
    place_m, covariance = cartesian(
        found.range_m, found.bearing_rad, found.elevation_rad, found.range_sigma_m, found.bearing_sigma_rad,
        found.elevation_sigma_rad,
    )  # fmt: skip
    flat, upright = covariance[:, [0, 0, 1], [0, 1, 1]], covariance[:, [0, 1, 2], [2, 2, 2]]
    if not found.has_elevation:  # nobody knows how high: a tilted frame must not take that for exact
        upright = np.column_stack([np.zeros((len(rows), 2)), flat[:, [0, 2]].mean(axis=1)])
    z_m = place_m[:, 2] if found.has_elevation else np.full(len(rows), np.nan)
    return rows.changed(first=place_m[:, 0], second=place_m[:, 1], z_m=z_m, covariance_m2=flat, height_covariance_m2=upright)


def measured(reader: ChannelReader, rows: Positions, suspicions: Suspicions) -> Measured:
    """What the rows [N] of a reader measured: range, bearing and elevation as messages have them are first, second and z."""
    unit = _angle_unit(reader, rows, suspicions)
    stated = reader.sigmas()
    range_sigma, bearing_sigma, elevation_sigma = (
        _sigma(reader, name, stated[:, column], unit if name != "range" else 1.0, suspicions)
        for column, name in enumerate(("range", "bearing", "elevation"))
    )
    elevation = rows.z_m * unit
    has_elevation = bool((np.nan_to_num(elevation) != 0).any())
    if not has_elevation:  # a radar of two dimensions leaves it zero
        elevation, elevation_sigma = np.zeros(len(rows)), np.zeros(len(rows))
    range_m = np.where(_is_distance(reader, rows, suspicions), rows.first, np.nan)
    bearing = _from_east(reader, rows.second * unit)
    return Measured(range_m, bearing, elevation, range_sigma, bearing_sigma, elevation_sigma, has_elevation)


def _from_east(reader: ChannelReader, bearing_rad: Float64s) -> Float64s:
    """Bearings [N] from the x axis of the source's frame towards y, or of an observer from east towards north."""
    heading_deg, is_compass = reader.source.observer_heading_deg, reader.paths.bearing_convention == "compass"
    if heading_deg is not None:
        ahead = np.pi / 2 - np.radians(heading_deg)
    else:
        ahead = np.pi / 2 if is_compass else 0.0
    found: Float64s = ahead - bearing_rad if is_compass else ahead + bearing_rad
    return found


def _angle_unit(reader: ChannelReader, rows: Positions, suspicions: Suspicions) -> float:
    """Radians of the unit of a source's angles; degrees in fields of radians are told."""
    if reader.paths.bearing_unit == "deg":
        return float(np.radians(1.0))
    if reader.source.bearing_unit is not None or not suspicions.looks_for("place"):
        return 1.0
    bearing, elevation = rows.second[np.isfinite(rows.second)], rows.z_m[np.isfinite(rows.z_m)]
    is_turned = len(bearing) and max(np.ptp(bearing), np.abs(bearing).max()) > _LITTLE_MORE * 2 * np.pi
    is_steep = len(elevation) and np.abs(elevation).max() > _LITTLE_MORE * np.pi / 2
    if not is_turned and not is_steep:
        return 1.0
    name, values, most = ("bearings", bearing, "2 pi") if is_turned else ("elevations", elevation, "pi / 2")
    suspicions.add(
        "place", reader.channel.topic,
        seen=f"{name} from {values.min():.4g} to {values.max():.4g}, beyond {most}: no radians",
        done="read as degrees", setting=f'bearing_unit = "deg" or "rad" in its [[extract.{reader.role}]]',
    )  # fmt: skip
    return float(np.radians(1.0))


def _is_distance(reader: ChannelReader, rows: Positions, suspicions: Suspicions) -> Bools:
    """Which ranges [N] are above zero; negative ones are told. Zero is what drivers leave in returns that are none."""
    found: Bools = rows.first > 0
    num_negative = int((rows.first < 0).sum())
    if num_negative and suspicions.looks_for("place"):
        suspicions.add(
            "place", reader.channel.topic,
            seen=f"{num_negative} of {len(rows)} ranges are negative, down to {np.nanmin(rows.first):.4g} m",
            done="they are left out", setting=f'where, or range = "PATH.@abs", in its [[extract.{reader.role}]]',
        )  # fmt: skip
    return found


def _sigma(reader: ChannelReader, name: str, stated: Float64s, unit: float, suspicions: Suspicions) -> Float64s:
    """Standard deviations [N] in metres or radians: the messages' where they are above zero, else that of the settings.

    Rows without either cannot be weighed and are left out (NaN).
    """
    setting = f"{name}_sigma_m" if name == "range" else f"{name}_sigma_deg"
    given = getattr(reader.paths, setting)
    default = np.nan if given is None else float(given if name == "range" else np.radians(given))
    is_good = np.isfinite(stated) & (stated > 0)
    num_bad = int((~is_good).sum())
    if getattr(reader.paths, f"{name}_sigma") and num_bad and suspicions.looks_for("covariance"):
        suspicions.add(
            "covariance", reader.channel.topic,
            seen=f"{num_bad} of {len(stated)} standard deviations of its {name} are not above zero",
            done="they are left out" if given is None else f"{given:g} {'m' if name == 'range' else 'degrees'} are taken",
            setting=f"{setting} in its [[extract.{reader.role}]] (without {name}_sigma), or where",
        )  # fmt: skip
    found: Float64s = np.where(is_good, stated * unit, default)
    if name == "bearing" and (found > _MOST_SIGMA_RAD).any():
        raise ConfigError(
            f"extract.{reader.role}, topic {reader.channel.topic}: a standard deviation of the bearing of "
            f"{np.degrees(np.nanmax(found)):.3g} degrees tells no position; correct bearing_sigma_deg or bearing_sigma"
        )
    return found


def assumed(reader: ChannelReader) -> str | None:
    """In words what accuracy is taken of a source that states none; None where it, or the user, does."""
    source, paths = reader.source, reader.paths
    if not reader.is_polar or (reader.is_stated and source.range_sigma_m is not None and source.bearing_sigma_deg is not None):
        return None
    if paths.bearing_sigma or paths.range_sigma:
        return None
    return (
        f"{reader.channel.topic}: {paths.range_sigma_m:g} m in range and {paths.bearing_sigma_deg:g}° in bearing are "
        "taken, as its type states no accuracy; range_sigma_m and bearing_sigma_deg in its [[extract.detections]] do"
    )
