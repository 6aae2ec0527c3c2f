"""Ranges and bearings as messages have them → metres and radians with their standard deviations, and positions of both.

The axes are those of the sensor's frame, which transforms bring into the mission's; of a source that says where its observer
was, east and north about that place (`observers`).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s
from cadence.errors import ConfigError
from cadence.measurement.doppler import are_static
from cadence.measurement.polar import cartesian, is_nearly_normal
from pipeline.extract.cameras import Camera
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.positions import Positions
from pipeline.suspicions import Suspicions

_LITTLE_MORE: Final = 1.01
"""Angles that are counted on over a full turn by a rounding are no degrees."""
_MOST_SIGMA_RAD: Final = 0.35
"""Beyond 20 degrees a beam tells a side of the sensor and no position."""
_STANDS_MPS: Final = 0.5
"""What a radar of vehicles tells of range rates, and less than somebody who walks towards it."""
_OF_SIZE: Final = 0.1
"""Where in its box a target is: a standard deviation of the box's centre in widths and heights of it."""
_UNITS: Final = {"range": "m", "bearing": "degrees", "elevation": "degrees", "range_rate": "m/s"}
SETTINGS: Final = {
    "range": "range_sigma_m", "bearing": "bearing_sigma_deg", "elevation": "elevation_sigma_deg",
    "range_rate": "range_rate_sigma_mps",
}  # fmt: skip
"""The setting that says how exact a value is where messages do not."""


@dataclass(frozen=True, eq=False)
class Measured:
    """What one source measured [N]: metres, radians from x towards y and from there towards z, and standard deviations.

    NaN stands for what is not measured, or cannot be meant.
    """

    range_m: Float64s
    bearing_rad: Float64s
    elevation_rad: Float64s
    range_rate_mps: Float64s
    range_sigma_m: Float64s
    bearing_sigma_rad: Float64s
    elevation_sigma_rad: Float64s
    range_rate_sigma_mps: Float64s

    @property
    def is_place(self) -> Bools:
        """Which rows [N] have a range and a bearing."""
        return np.isfinite(self.range_m) & np.isfinite(self.bearing_rad)

    @property
    def is_bent(self) -> Bools:
        """Which of these are no normal positions, as the beam is too wide."""
        return self.is_place & ~is_nearly_normal(self.range_m, self.range_sigma_m, self.bearing_sigma_rad)


def as_positions(rows: Positions, found: Measured) -> Positions:
    """The rows [N] as positions in the axes of their sensor; NaN where range or bearing are."""
    has_elevation = np.isfinite(found.elevation_rad)
    place_m, covariance = cartesian(
        found.range_m, found.bearing_rad, np.where(has_elevation, found.elevation_rad, 0.0), found.range_sigma_m,
        found.bearing_sigma_rad, np.where(has_elevation, found.elevation_sigma_rad, 0.0),
    )  # fmt: skip
    flat, upright = covariance[:, [0, 0, 1], [0, 1, 1]], covariance[:, [0, 1, 2], [2, 2, 2]]
    # nobody knows how high: a tilted frame must not take that for exact
    unknown = np.column_stack([np.zeros((len(rows), 2)), flat[:, [0, 2]].mean(axis=1)])
    return rows.changed(
        first=place_m[:, 0], second=place_m[:, 1], z_m=np.where(has_elevation, place_m[:, 2], np.nan), covariance_m2=flat,
        height_covariance_m2=np.where(has_elevation[:, None], upright, unknown),
    )  # fmt: skip


def measured(reader: ChannelReader, rows: Positions, suspicions: Suspicions) -> Measured:
    """What the rows [N] of a reader measured: range, bearing and elevation as messages have them are first, second and z."""
    unit, stated = _angle_unit(reader, rows, suspicions), reader.measured()
    range_m = np.where(_is_distance(reader, rows, suspicions), rows.first, np.nan)
    elevation = rows.z_m * unit
    if not (np.nan_to_num(elevation) != 0).any():  # a radar of two dimensions leaves it zero
        elevation = np.full(len(rows), np.nan)
    values = {
        "range": range_m, "bearing": _from_east(reader, rows.second * unit), "elevation": elevation,
        "range_rate": stated["range_rate"],
    }  # fmt: skip
    sigmas = {
        name: _sigma(reader, name, value, stated[f"{name}_sigma"] * (unit if _UNITS[name] == "degrees" else 1.0), suspicions)
        for name, value in values.items()
    }
    _check_beam(reader, sigmas["bearing"])
    known = [np.where(np.isfinite(sigmas[name]), value, np.nan) for name, value in values.items()]
    return Measured(*known, *sigmas.values())


def seen(reader: ChannelReader, rows: Positions, camera: Camera) -> Measured:
    """The directions in which a camera saw what is at pixels [N], which are second and z: left of and above its axis."""
    stated, sigma = reader.measured(), reader.source.pixel_sigma
    right, down = camera.slopes(np.column_stack([rows.second, rows.z_m])).T
    sides = (stated["box_width"], stated["box_height"])
    pixels = [np.maximum(1.0, _OF_SIZE * np.nan_to_num(side)) if sigma is None else np.full(len(rows), sigma) for side in sides]
    elevation = np.arctan2(-down, np.hypot(1.0, right))
    across, upright = (exact / focal for exact, focal in zip(pixels, camera.focal, strict=True))
    nothing = np.full(len(rows), np.nan)
    return Measured(nothing, -np.arctan(right), elevation, nothing, nothing, across, upright, nothing)


def stand_still(reader: ChannelReader, rows: Positions, found: Measured, has_name: Bools) -> Bools:
    """Which rows [N] without a name stand, by the Doppler of their scan; none where the source wants them, or measures none."""
    rates = reader.measured()["range_rate"]
    nothing = np.zeros(len(rows), np.bool_)
    if reader.source.is_static_used or has_name.all() or not (np.nan_to_num(rates) != 0).any():
        return nothing
    flat = np.cos(np.nan_to_num(found.elevation_rad))
    ways = np.column_stack([flat * np.cos(found.bearing_rad), flat * np.sin(found.bearing_rad)])
    usable = np.where(found.is_place & ~has_name, rates, np.nan)
    order = np.argsort(rows.message, kind="stable")
    for scan in np.split(order, np.flatnonzero(np.diff(rows.message[order])) + 1):
        nothing[scan] = are_static(ways[scan], usable[scan], _STANDS_MPS)
    return nothing


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


def _sigma(reader: ChannelReader, name: str, value: Float64s, stated: Float64s, suspicions: Suspicions) -> Float64s:
    """Standard deviations [N] in metres or radians: the messages' where they are above zero, else that of the settings.

    NaN without either: such a value cannot be weighed and is left out.
    """
    given = getattr(reader.paths, SETTINGS[name])
    default = np.nan if given is None else float(np.radians(given) if _UNITS[name] == "degrees" else given)
    is_good = np.isfinite(stated) & (stated > 0)
    is_bad = ~is_good & np.isfinite(value)
    if getattr(reader.paths, f"{name}_sigma") and is_bad.any() and suspicions.looks_for("covariance"):
        suspicions.add(
            "covariance", reader.channel.topic,
            seen=f"{int(is_bad.sum())} of {len(stated)} standard deviations of its {name} are not above zero",
            done="they are left out" if given is None else f"{given:g} {_UNITS[name]} are taken",
            setting=f"{SETTINGS[name]} in its [[extract.{reader.role}]] (without {name}_sigma), or where",
        )  # fmt: skip
    return np.where(is_good, stated, default)


def _check_beam(reader: ChannelReader, sigma_rad: Float64s) -> None:
    """`ConfigError` where bearings are too vague for what is to be made of them."""
    most_rad, what = (_MOST_SIGMA_RAD, "position") if reader.paths.range else (np.pi / 2, "direction")
    if (sigma_rad > most_rad).any():
        raise ConfigError(
            f"extract.{reader.role}, topic {reader.channel.topic}: a standard deviation of the bearing of "
            f"{np.degrees(np.nanmax(sigma_rad)):.3g} degrees tells no {what}; correct bearing_sigma_deg or bearing_sigma"
        )


def assumed(reader: ChannelReader) -> str | None:
    """In words what accuracy is taken of a source that states none; None where it, or the user, does."""
    source, paths = reader.source, reader.paths
    if not (paths.range and paths.bearing) or (
        reader.is_stated and source.range_sigma_m is not None and source.bearing_sigma_deg is not None
    ):
        return None
    if paths.bearing_sigma or paths.range_sigma:
        return None
    return (
        f"{reader.channel.topic}: {paths.range_sigma_m:g} m in range and {paths.bearing_sigma_deg:g}° in bearing are "
        "taken, as its type states no accuracy; range_sigma_m and bearing_sigma_deg in its [[extract.detections]] do"
    )
