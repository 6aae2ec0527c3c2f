"""Message types of what radars measure: ranges and bearings from where they are, which become positions."""

from dataclasses import replace
from typing import Final

from pipeline.mapping.message_type import OWN_SENSOR, MessageType

_RADAR: Final = MessageType(
    (), range_sigma_m=0.5, bearing_sigma_deg=1.0, elevation_sigma_deg=2.0, vertical_datum="frame", role="detections"
)
"""Where messages state no accuracy: that of radars for vehicles, rather a little worse than their data sheets have it."""


RADARS: Final[dict[str, MessageType]] = {
    # REP 103: anticlockwise, up. The first drafts had `points`, and angles the other way round: those are not read.
    "RadarScan": replace(
        _RADAR,
        schemas=("radar_msgs.RadarScan",),
        range=("returns[:].range",),
        bearing=("returns[:].azimuth",),
        elevation=("returns[:].elevation",),
        range_rate=("returns[:].doppler_velocity",),
    ),
    # Its driver, its filters and CARLA's bridge have degrees; target_id is the number of a return, not of a target.
    "RadarTargetArray": replace(
        _RADAR,
        schemas=("ainstein_radar_msgs.RadarTargetArray",),
        range=("targets[:].range",),
        bearing=("targets[:].azimuth",),
        elevation=("targets[:].elevation",),
        range_rate=("targets[:].speed",),
        bearing_unit="deg",
    ),
    "ContinentalArs548DetectionList": replace(
        _RADAR,
        schemas=("continental_msgs.ContinentalArs548DetectionList",),
        range=("detections[:].range",),
        bearing=("detections[:].azimuth_angle",),
        elevation=("detections[:].elevation_angle",),
        range_rate=("detections[:].range_rate",),
        range_sigma=("detections[:].range_std",),
        bearing_sigma=("detections[:].azimuth_angle_std",),
        elevation_sigma=("detections[:].elevation_angle_std",),
        range_rate_sigma=("detections[:].range_rate_std",),
    ),
    "Bearing": MessageType(
        ("mission.Bearing",),
        range=("range",),
        bearing=("bearing",),
        range_sigma=("range_sigma",),
        bearing_sigma=("bearing_sigma",),
        bearing_unit="deg",
        bearing_convention="compass",
        observer=OWN_SENSOR,
        agent=("agent_id",),
        sensor=("sensor_id",),
        role="detections",
        names_agents=True,
    ),
}
