"""Metres whose messages say where on the earth they count from: of several vehicles, and after a reset, about one place."""

import numpy as np

from cadence.arrays import Float64s
from pipeline.extract.channel_reader import ORIGIN, ChannelReader
from pipeline.extract.positions import Positions
from pipeline.frames import DEFAULT_FRAME_ID, to_geodetic, to_local
from pipeline.tables import Frame

Parts = dict[str, list[tuple[ChannelReader, Positions]]]
Place = tuple[float, float]


def about_one_origin(parts: Parts) -> tuple[Parts, Place | None]:
    """The rows by role and reader, those that count from another place moved to count from the first; and that place.

    None where other metres of the log do not say where they count from: they may lie anywhere.
    """
    origins = {id(reader): _origins(reader) for found in parts.values() for reader, rows in found if len(rows)}
    known = [each for each in origins.values() if each is not None]
    places = np.concatenate([each[~np.isnan(each[:, 0])] for each in known]) if known else np.zeros((0, 2))
    if not len(places):
        return parts, None
    first = (float(places[0, 0]), float(places[0, 1]))

    def moved(reader: ChannelReader, rows: Positions) -> Positions:
        of_reader = origins.get(id(reader))
        return rows if of_reader is None else _moved(rows, of_reader, first, reader.is_ned)

    found = {role: [(reader, moved(reader, rows)) for reader, rows in each] for role, each in parts.items()}
    are_known = all(
        reader.is_geodetic or (id(reader) in origins and origins[id(reader)] is not None)
        for each in parts.values() for reader, rows in each if len(rows)
    )  # fmt: skip
    return found, first if are_known else None


def _origins(reader: ChannelReader) -> Float64s | None:
    """Latitude and longitude [N, 2] from which the rows of a reader count, NaN where they do not say so; None for others."""
    if reader.more != ORIGIN:
        return None
    measured = reader.measured()
    found = np.column_stack([measured[name] for name in ORIGIN])
    is_place = np.isfinite(found).all(axis=1) & (found != 0).any(axis=1) & (np.abs(found) <= [90, 180]).all(axis=1)
    return np.where(is_place[:, None], found, np.nan)


def _moved(rows: Positions, origins: Float64s, first: Place, is_ned: bool) -> Positions:
    """The rows [N], which count from places [N, 2], counting from `first`."""
    there = Frame(DEFAULT_FRAME_ID, *first)
    x_m, y_m = (rows.second.copy(), rows.first.copy()) if is_ned else (rows.first.copy(), rows.second.copy())
    for place in np.unique(origins[~np.isnan(origins[:, 0])], axis=0).tolist():
        chosen = (origins == place).all(axis=1)
        if tuple(place) != first:
            x_m[chosen], y_m[chosen] = to_local(there, *to_geodetic(Frame(DEFAULT_FRAME_ID, *place), x_m[chosen], y_m[chosen]))
    return rows.changed(first=y_m, second=x_m) if is_ned else rows.changed(first=x_m, second=y_m)
