"""Columns of coordinates → degrees or metres, or a refusal where they may be exchanged, or in another unit."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from cadence.arrays import Bools, Float64s
from cadence.errors import InputError
from pipeline.importing.names import METRES
from pipeline.importing.table_file import TableFile

_NO_LATITUDE, _NO_LONGITUDE = 91.0, 181.0
"""What AIS sends where it knows no position."""
_MAX_JUNK: Final = 0.01
"""Of rows off the earth, which are left out; with more, the column is not what it seems."""
_RADIANS: Final = (np.pi / 2, np.pi)


@dataclass(frozen=True, eq=False)
class Places:
    """Positions [N]: latitude and longitude in degrees, or x and y in metres; NaN where a row has none.

    words     how they were taken
    left_out  which rows have none, by reason [N]
    """

    first: Float64s
    second: Float64s
    is_geodetic: bool
    words: str
    left_out: Mapping[str, Bools]


@dataclass(frozen=True)
class Naming:
    """What two columns are called, the unit that is stated for them (empty: none), and whether the user named the columns."""

    first: str
    second: str
    unit: str
    is_stated: bool


def degrees(table: TableFile, latitude: Float64s, longitude: Float64s, naming: Naming) -> Places:
    """Latitudes and longitudes [N] of columns in the unit that is stated, else in degrees.

    Raises `InputError` where latitudes lie beyond the poles, or all of them so near zero that they may be radians.
    """
    unit = naming.unit or "deg"
    is_unset = (latitude == _NO_LATITUDE) | (longitude == _NO_LONGITUDE)
    latitude, longitude = (_in_degrees(np.where(is_unset, np.nan, column), unit) for column in (latitude, longitude))
    known = np.isfinite(latitude) & np.isfinite(longitude)
    is_off = known & (
        (np.abs(latitude) > 90) | (np.abs(longitude) > 360) | ((longitude > 180) & (longitude[known].min(initial=0) < 0))
    )
    if is_off.any():
        _check_off(table, latitude, longitude, is_off, known, naming, unit)
    words = unit
    if (longitude[known & ~is_off] > 180).any():
        longitude = np.where(longitude > 180, longitude - 360, longitude)
        words += ", longitudes of 0 to 360"
    known &= ~is_off
    near = known.any() and all(
        np.abs(column[known]).max() <= limit for column, limit in zip((latitude, longitude), _RADIANS, strict=True)
    )
    if near and not naming.unit and (np.abs(latitude[known]) + np.abs(longitude[known])).max() > 0:
        raise InputError(
            f"{table.path}: columns {naming.first!r} and {naming.second!r} may be radians: no latitude is beyond "
            f"{np.abs(latitude[known]).max():.3g}; give --unit rad, or --unit deg"
        )
    left_out = {"positions that say that there is none (91, 181)": is_unset, "positions off the earth": is_off}
    keep = known & ~is_unset
    return Places(np.where(keep, latitude, np.nan), np.where(keep, longitude, np.nan), True, words, left_out)


def metres(table: TableFile, x: Float64s, y: Float64s, naming: Naming) -> Places:
    """Positions x, y [N] in metres; `InputError` where nothing says that they are no degrees."""
    known = np.isfinite(x) & np.isfinite(y)
    may_be_degrees = known.any() and np.abs(x[known]).max() <= 180 and np.abs(y[known]).max() <= 90
    if may_be_degrees and not (naming.unit or naming.is_stated):
        raise InputError(
            f"{table.path}: columns {naming.first!r} and {naming.second!r} may be metres or degrees; give --unit m, or "
            f"--column longitude={naming.first} --column latitude={naming.second}"
        )
    unit = naming.unit or "m"
    return Places(np.where(known, x * METRES[unit], np.nan), np.where(known, y * METRES[unit], np.nan), False, unit, {})


def _in_degrees(column: Float64s, unit: str) -> Float64s:
    if unit == "rad":
        return np.rad2deg(column)
    if unit == "1e-7 deg":
        return column / 1e7
    if unit == "ddmm.mm":
        whole = np.floor(np.abs(column) / 100)
        found: Float64s = np.sign(column) * (whole + (np.abs(column) - 100 * whole) / 60)
        return found
    return column


def _check_off(
    table: TableFile, latitude: Float64s, longitude: Float64s, is_off: Bools, known: Bools, naming: Naming, unit: str
) -> None:
    """Raise where positions off the earth are more than the odd one, with what they look like."""
    num_off, num_known = int(is_off.sum()), int(known.sum())
    row = int(np.flatnonzero(is_off)[0])
    seen = f"{naming.first!r} and {naming.second!r} are {latitude[row]:g} and {longitude[row]:g} in {table.place(row)}"
    beyond = np.abs(latitude[known]) > 90
    may_be_exchanged = beyond.any() and (np.abs(longitude[known]) <= 90).all() and (np.abs(latitude[known]) <= 180).all()
    if may_be_exchanged and not naming.is_stated:
        raise InputError(
            f"{table.path}: latitude and longitude may be exchanged: {seen}; give --column latitude={naming.second} "
            f"--column longitude={naming.first}, or the other way round"
        )
    if num_off <= _MAX_JUNK * num_known:
        return
    if num_off < num_known:
        raise InputError(
            f"{table.path}: {num_off} of {num_known} positions are off the earth ({seen}): units are mixed, or rows are wrong; "
            "correct the table"
        )
    raise InputError(
        f"{table.path}: no position is on the earth in {unit}: {seen}; give --unit '1e-7 deg', 'ddmm.mm' (degrees and minutes, "
        "as NMEA has them) or m, or other columns with --column"
    )
