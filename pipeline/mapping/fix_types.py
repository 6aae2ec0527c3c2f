"""Message types of positions in latitude and longitude: receivers and autopilots, ships (AIS), aircraft (ADS-B), GeoJSON.

Receivers that state integers have them in 1e-7 degrees and millimetres.
"""

from dataclasses import replace
from typing import Final

from pipeline.mapping.message_type import FRAME_PATHS, TIME_PATHS, MessageType, geodetic

_NOT_SHIPS = (4, 17, 21)
"""AIS messages of base stations, of stations that correct GNSS, and of aids to navigation."""
_NO_REPORTS = (
    "BaseStationReport",
    "GnssBroadcastBinaryMessage",
    "AidsToNavigationReport",
    "ShipStaticData",
    "StaticDataReport",
)
"""The same by aisstream's names, and what repeats the last position of a ship."""
_FEATURES = 'features[:]{geometry.type=="Point"}'
_POINTS = (f"{_FEATURES}.geometry.coordinates", '{geometry.type=="Point"}.geometry.coordinates')


FIXES: Final[dict[str, MessageType]] = {
    "NavSatFix": replace(geodetic("sensor_msgs.NavSatFix", vertical_datum="ellipsoid"), where=("status.status >= 0",)),
    "GPSFix": replace(
        geodetic("gps_msgs.GPSFix", vertical_datum="sea level"),
        schemas=("gps_msgs.GPSFix", "gps_common.GPSFix"),
        where=("status.status >= 0",),
    ),
    # As JSON it may say who was seen and who saw it: `cadence import` writes it so.
    "LocationFix": replace(geodetic("foxglove.LocationFix"), agent=("agent_id",), sensor=("sensor_id",)),
    "LocationFixes": replace(
        geodetic("foxglove.LocationFixes", "fixes[:]."),
        time=tuple(f"fixes[:].{path}" for path in TIME_PATHS),
        frame_id=tuple(f"fixes[:].{path}" for path in FRAME_PATHS),
    ),
    "GeoPointStamped": geodetic("geographic_msgs.GeoPointStamped", "position.", vertical_datum="ellipsoid"),
    "GeoPoseStamped": geodetic("geographic_msgs.GeoPoseStamped", "pose.position.", vertical_datum="ellipsoid"),
    "GeoPoseWithCovarianceStamped": replace(
        geodetic("geographic_msgs.GeoPoseWithCovarianceStamped", "pose.pose.position.", vertical_datum="ellipsoid"),
        covariance=("pose.covariance",),
        covariance_type=(),
        is_north_first=True,
    ),
    "NavPVT": MessageType(
        ("ublox_msgs.NavPVT", "ublox_msgs.NavPVT7"),
        latitude=("lat.@div(1e7)",),
        longitude=("lon.@div(1e7)",),
        altitude=("h_msl.@div(1000)", "hMSL.@div(1000)", "height.@div(1000)"),
        vertical_datum="sea level",
        sigma=("h_acc.@div(1000)", "hAcc.@div(1000)"),
        where=("flags & 1", "fix_type != 0", "fix_type != 5", "fixType != 0", "fixType != 5"),
    ),
    "GPSRAW": MessageType(
        ("mavros_msgs.GPSRAW",),
        latitude=("lat.@div(1e7)",),
        longitude=("lon.@div(1e7)",),
        altitude=("alt.@div(1000)",),
        vertical_datum="sea level",
        sigma=("h_acc.@div(1000)",),
        where=("fix_type >= 2",),
    ),
    "BESTPOS": MessageType(
        ("novatel_oem7_msgs.BESTPOS",),
        latitude=("lat",),
        longitude=("lon",),
        altitude=("hgt",),
        vertical_datum="sea level",
        sigma=("lat_stdev",),
        where=("sol_status.status == 0",),
    ),
    "SbgGpsPos": replace(
        geodetic("sbg_driver.SbgGpsPos", vertical_datum="sea level"),
        covariance=(),
        sigma=("position_accuracy.x",),
        where=("status.status == 0",),
    ),
    "VehicleGlobalPosition": MessageType(
        ("px4_msgs.VehicleGlobalPosition", "px4_msgs.VehicleGlobalPositionGroundtruth"),
        latitude=("lat",),
        longitude=("lon",),
        altitude=("alt",),
        vertical_datum="sea level",
        sigma=("eph",),
        where=("lat_lon_valid",),
    ),
    "SensorGps": MessageType(
        ("px4_msgs.SensorGps", "px4_msgs.VehicleGpsPosition"),
        latitude=("latitude_deg", "lat.@div(1e7)"),
        longitude=("longitude_deg", "lon.@div(1e7)"),
        altitude=("altitude_msl_m", "alt.@div(1000)"),
        vertical_datum="sea level",
        sigma=("eph",),
        where=("fix_type >= 2",),
        time=("time_utc_usec", *TIME_PATHS),
    ),
    "TransponderReport": MessageType(
        ("px4_msgs.TransponderReport",),
        latitude=("lat",),
        longitude=("lon",),
        altitude=("altitude",),
        vertical_datum="sea level",
        where=("flags & 1",),
        agent=("icao_address",),
        role="detections",
        names_agents=True,
    ),
    "ADSBVehicle": MessageType(
        ("mavros_msgs.ADSBVehicle",),
        latitude=("latitude",),
        longitude=("longitude",),
        altitude=("altitude",),
        vertical_datum="sea level",
        where=("flags & 1",),
        agent=("icao_address", "ICAO_address"),
        role="detections",
        names_agents=True,
    ),
    "AISContact": replace(
        geodetic("marine_ais_msgs.AISContact", "pose.position."),
        covariance=("covariance",),
        covariance_type=(),
        is_north_first=True,
        where=tuple(f"position_message_id != {number}" for number in _NOT_SHIPS),
        agent=("id",),
        role="detections",
        names_agents=True,
    ),
    # JSON of AIS decoders, which has no schema: gpsd and AIS-catcher (type), pyais (msg_type), aisstream (MetaData).
    "AIS": MessageType(
        (),
        latitude=("lat", "latitude", "MetaData.latitude"),
        longitude=("lon", "longitude", "MetaData.longitude"),
        where=(
            *(f"{name} != {number}" for name in ("type", "msg_type") for number in _NOT_SHIPS),
            *(f'MessageType != "{name}"' for name in _NO_REPORTS),
        ),
        time=("time", "rxuxtime", "MetaData.time_utc"),
        agent=("mmsi", "MMSI", "MetaData.MMSI"),
        role="detections",
        names_agents=True,
    ),
    "GeoJSON": MessageType(
        ("foxglove.GeoJSON",),
        latitude=tuple(f"{point}[1]" for point in _POINTS),
        longitude=tuple(f"{point}[0]" for point in _POINTS),
        altitude=tuple(f"{point}[2]" for point in _POINTS),
        vertical_datum="ellipsoid",
        json_text="geojson",
        agent=tuple(
            f"{feature}{name}"
            for feature in ("features[:].", "")
            for name in ("id", "properties.id", "properties.icao", "properties.mmsi", "properties.name")
        ),
        names_agents=True,
        is_suggested=False,
    ),
}
