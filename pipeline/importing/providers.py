"""Tables whose columns are known by their names, with what their providers say of times and units."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Final

from pipeline.importing.names import key_of


@dataclass(frozen=True)
class Provider:
    """A kind of table.

    needs    names (as of `key_of`) by which it is known; all of them
    columns  names of what they are columns of, the first that is there; what is not listed is guessed as in any table
    zone     of times that state none, as the provider says; empty: it does not say
    order    of day and month, where the provider says it
    units    of columns that do not say theirs
    sigma_scale  standard deviations in what the table calls accuracy
    drop     values of columns whose rows are no positions of targets
    note     what is to be known
    """

    name: str
    needs: tuple[str, ...]
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    zone: str = ""
    order: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    sigma_scale: float = 1.0
    drop: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    note: str = ""


_AIS_OTHERS: Final = ("base station", "aton", "ais aid to navigation", "base_station")

PROVIDERS: Final = (
    Provider(
        "AIS of MarineCadastre (NOAA)",
        ("mmsi", "basedatetime", "lat", "lon"),
        {"time": ("basedatetime",), "agent": ("mmsi",)},
        zone="UTC",
    ),
    Provider(
        "AIS of MarineCadastre (NOAA)",
        ("mmsi", "base_date_time", "latitude", "longitude"),
        {"time": ("base_date_time",), "agent": ("mmsi",)},
        zone="UTC",
    ),
    Provider(
        "AIS of the Danish Maritime Authority",
        ("timestamp", "type_of_mobile", "mmsi", "latitude", "longitude"),
        {"time": ("timestamp",), "agent": ("mmsi",)},
        order="day-first",
        drop={"type_of_mobile": _AIS_OTHERS},
    ),
    Provider(
        "state vectors of OpenSky",
        ("icao24", "lat", "lon", "lastposupdate"),
        {"time": ("lastposupdate",), "agent": ("icao24",), "altitude": ("geoaltitude", "baroaltitude")},
        units={"altitude": "m"},
        note="a state repeats the last position: lastposupdate is when it was heard, and repetitions are left out",
    ),
    Provider(
        "Movebank",
        ("timestamp", "location_long", "location_lat"),
        {
            "time": ("timestamp",),
            "agent": ("individual_local_identifier", "individual_id", "tag_local_identifier", "tag_id"),
            "altitude": ("height_above_ellipsoid", "height_above_msl"),
        },
        zone="UTC",
        units={"altitude": "m"},
        drop={"visible": ("false",)},
    ),
    Provider(
        "GPSLogger for Android",
        ("time", "lat", "lon", "elevation", "accuracy", "bearing"),
        {"time": ("time",), "altitude": ("elevation",), "sigma": ("accuracy",), "sensor": ("provider",)},
        units={"altitude": "m"},
        # Android's accuracy is the radius that holds 68 %: of a round normal law that is sqrt(-2 ln 0.32) sigma.
        sigma_scale=1 / 1.5096,
        note="accuracy is the radius that holds 68 %, and becomes the standard deviation that belongs to it",
    ),
)
"""Known tables; of the same names only one."""


def provider_of(names: Collection[str]) -> Provider | None:
    """The kind of table that has columns of these names; None for one that is not known."""
    keys = {key_of(name) for name in names}
    return next((provider for provider in PROVIDERS if keys.issuperset(provider.needs)), None)
