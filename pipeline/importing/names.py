"""What the names of columns say: fields, in the order of how sure a name is, and units."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

FIELDS: Final = {
    "time": "time",
    "date": "date, where the time is a time of day",
    "latitude": "latitude",
    "longitude": "longitude",
    "north_south": "N or S of the latitude",
    "east_west": "E or W of the longitude",
    "x": "x, east",
    "y": "y, north",
    "altitude": "altitude",
    "agent": "who was seen",
    "sensor": "who saw it",
    "sigma": "standard deviation",
    "cov_xx": "covariance, east east",
    "cov_xy": "covariance, east north",
    "cov_yy": "covariance, north north",
    "truth": "whether it is the truth",
}
"""What a column may hold, in the order in which it is shown."""

UNITS: Final = {
    "time": ("s", "ms", "us", "ns"),
    "latitude": ("deg", "rad", "1e-7 deg", "ddmm.mm"),
    "x": ("m", "km", "ft"),
    "altitude": ("m", "km", "ft"),
    "sigma": ("m", "km", "ft"),
}
"""Units that a column may be stated in; those of longitude and y are those of latitude and x."""

METRES: Final = {"m": 1.0, "km": 1000.0, "ft": 0.3048}
_SAME_UNITS: Final = {"longitude": "latitude", "y": "x"}
_SPELLINGS: Final = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms", "usec": "us",
    "micros": "us", "microseconds": "us", "nsec": "ns", "nanos": "ns", "nanoseconds": "ns", "degree": "deg", "degrees": "deg",
    "radians": "rad", "metre": "m", "metres": "m", "meter": "m", "meters": "m", "feet": "ft", "foot": "ft", "kilometres": "km",
    "kilometers": "km", "dd": "deg",
}  # fmt: skip

# Each name stands in the group of those that say the same thing equally surely.
_EXACT: Final[dict[str, tuple[tuple[str, ...], ...]]] = {
    "time": (
        ("time", "timestamp", "datetime", "date_time", "time_stamp", "utc_time", "time_utc", "utc", "timestamp_utc",
         "utc_timestamp", "datetime_utc", "utc_datetime", "date_time_utc", "utc_date_time", "basedatetime", "base_date_time",
         "epoch", "unix_time", "unixtime", "unix_timestamp", "epoch_time", "posix_time", "fix_time", "gps_time", "event_date",
         "eventdate", "acquisition_time", "time_of_fix", "local_time", "time_local", "study_local_timestamp"),
        ("t", "stamp", "recorded_at", "observed_at", "created_at", "received_at", "last_seen"),
    ),
    "date": (("date", "utc_date", "date_utc", "gps_date", "day", "local_date", "date_local"),),
    "latitude": (
        ("latitude", "lat", "location_lat", "decimallatitude", "decimal_latitude", "gps_latitude", "gps_lat", "position_lat",
         "pos_lat", "lat_wgs84", "latitude_wgs84", "geo_lat", "y_lat", "coordinates_latitude", "geometry_latitude",
         "latitude_n_s"),
    ),
    "longitude": (
        ("longitude", "lon", "long", "lng", "location_long", "location_lon", "decimallongitude", "decimal_longitude",
         "gps_longitude", "gps_lon", "position_lon", "pos_lon", "lon_wgs84", "longitude_wgs84", "geo_lon", "x_lon",
         "coordinates_longitude", "geometry_longitude", "longitude_e_w"),
    ),
    "north_south": (("n_s", "ns", "lat_dir", "lat_ns", "latitude_direction", "north_south", "latitude_hemisphere"),),
    "east_west": (("e_w", "ew", "lon_dir", "lon_ew", "longitude_direction", "east_west", "longitude_hemisphere"),),
    "x": (("x", "east", "easting", "pos_x", "position_x", "utm_x", "utm_easting", "utm_east", "geometry_x"),),
    "y": (("y", "north", "northing", "pos_y", "position_y", "utm_y", "utm_northing", "utm_north", "geometry_y"),),
    "altitude": (
        ("altitude", "alt", "elevation", "ele", "elev", "height", "z", "geoaltitude", "geo_altitude", "height_above_ellipsoid",
         "height_above_msl", "altitude_msl", "coordinates_altitude", "position_z", "pos_z"),
        ("baroaltitude", "baro_altitude"),
    ),
    "agent": (
        ("agent_id", "agent"),
        ("mmsi", "icao24", "icao", "icao_address", "hex", "individual_local_identifier"),
        ("track_id", "trackid", "target_id", "targetid", "individual_id", "individualid", "animal_id", "animalid", "vessel_id",
         "vesselid", "ship_id", "shipid", "object_id", "objectid", "trajectory_id", "trajectoryid", "traj_id", "device_id",
         "deviceid", "entity_id", "platform_id"),
        ("tag_local_identifier", "tag_id", "tagid", "bird_id", "imo", "callsign", "call_sign", "registration", "flight"),
        ("id", "uid", "identifier", "individual", "animal", "vessel", "ship", "target", "device", "track", "name", "vesselname",
         "vessel_name", "shipname"),
    ),
    "sensor": (
        ("sensor_id", "sensor"), ("receiver_id", "receiver", "station_id", "station", "radar_id", "camera_id"), ("source",),
    ),
    "sigma": (
        ("sigma", "std", "standard_deviation"),
        ("accuracy", "horizontal_accuracy", "h_acc", "hacc", "horizontal_error", "eph", "location_error_numerical"),
    ),
    "cov_xx": (("cov_xx", "cov_xx_m2"),),
    "cov_xy": (("cov_xy", "cov_xy_m2"),),
    "cov_yy": (("cov_yy", "cov_yy_m2"),),
    "truth": (("is_truth", "truth", "ground_truth", "is_ground_truth", "gt"),),
}  # fmt: skip

_WHOLE: Final = {key for groups in _EXACT.values() for group in groups for key in group}
_MANY: Final = {"agent", "sensor", "altitude"}
"""Of these the first name is taken where several are equally sure: they say the same of a row, or are not needed."""


@dataclass(frozen=True)
class Guess:
    """The columns that may hold a field, all equally likely by their names."""

    names: tuple[str, ...]

    @property
    def is_sure(self) -> bool:
        """Whether there is one only."""
        return len(self.names) == 1


def key_of(name: str) -> str:
    """A name in small letters with _ between its words, without its unit: `Lat (deg)` and `lat` are the same."""
    return _split(name)[0]


def unit_of(name: str, what: str) -> str:
    """The unit that a name states for a field; empty where it states none that the field may have."""
    unit = _split(name)[1]
    return unit if unit in units_of(what) else ""


def units_of(what: str) -> tuple[str, ...]:
    """The units that a field may be stated in."""
    return UNITS.get(_SAME_UNITS.get(what, what), ())


def words_in(name: str) -> set[str]:
    """The words of a name, in small letters."""
    return set(re.split(r"[^a-z0-9]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).lower()))


def guess(what: str, names: Sequence[str]) -> Guess | None:
    """The columns whose names fit a field best; None where none fits."""
    keys = {name: key_of(name) for name in names}
    for group in _EXACT[what]:
        found = [name for key in group for name in names if keys[name] == key]
        if found:
            return Guess((found[0],) if what in _MANY else tuple(dict.fromkeys(found)))
    return None


def _split(name: str) -> tuple[str, str]:
    """The key of a name, and the unit at its end."""
    plain = re.sub(r"[^a-z0-9²]+", "_", name.strip().lower().replace("°", "deg").replace("µ", "u")).strip("_")
    if plain in _WHOLE:  # N/S is no n in seconds
        return plain, ""
    key, _, last = plain.rpartition("_")
    last = _SPELLINGS.get(last, last)
    is_unit = bool(key) and any(last in units for units in UNITS.values())
    return (key, last) if is_unit else (plain, "")
