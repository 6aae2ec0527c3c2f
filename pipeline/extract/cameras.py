"""How the cameras of a log see: sensor_msgs/CameraInfo → what direction a pixel is.

A pinhole with the distortion of Brown and Conrady (`plumb_bob`: Brown, "Close-range camera calibration", Photogrammetric
Engineering 37, 1971), whose inverse is found by fixed point iteration, as OpenCV does. Other distortions are refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cadence.arrays import Float64s
from cadence.errors import ConfigError
from pipeline.extract.channel_reader import ChannelReader
from pipeline.logs.decode import UndecodableChannel, UndecodableMessage, decoder_for
from pipeline.logs.reader import Channel, MissionLog
from pipeline.mapping.message_types import normalise_schema
from pipeline.suggestions import did_you_mean

_CAMERA_INFO: Final = "sensor_msgs.CameraInfo"
_ITERATIONS: Final = 30
_CLOSE: Final = 1e-6
"""Of the focal length: a thousandth of a pixel. What does not come as close lies beyond what the distortion describes."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: focal lengths and centre in pixels, the five coefficients of its distortion, and its optical frame."""

    topic: str
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, ...]
    frame_id: str

    def slopes(self, pixels: Float64s) -> Float64s:
        """How far right and down pixels [N, 2] look over how far ahead [N, 2]; NaN where no direction is seen there."""
        seen = (pixels - self.centre) / self.focal
        if not any(self.distortion):
            return np.asarray(seen)
        found = seen.copy()
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                found = found + seen - self._distorted(found)
            is_close = np.abs(self._distorted(found) - seen).max(axis=1) < _CLOSE
        return np.where(is_close[:, None], found, np.nan)

    def _distorted(self, slopes: Float64s) -> Float64s:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = slopes.T
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
        bent_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
        return np.column_stack([bent_x, bent_y])


def read_cameras(log: MissionLog, readers: Sequence[ChannelReader]) -> dict[int, Camera]:
    """The cameras of readers of pixels, by their channels' ids; `ConfigError` where one is not known, or cannot be meant."""
    return {reader.channel.id: _read(log, reader, _channel(log, reader)) for reader in readers if reader.is_camera}


def _channel(log: MissionLog, reader: ChannelReader) -> Channel:
    """The channel that tells how a reader's camera sees: as stated, or the only one nearest by its name."""
    known = {c.topic: c for c in log.channels if normalise_schema(c.schema_name) == _CAMERA_INFO}
    where, stated = f"extract.detections, topic {reader.channel.topic}", reader.source.camera_info
    if stated is not None:
        if stated not in known:
            listed = ", ".join(sorted(known)) or "none"
            raise ConfigError(
                f"{where}: camera_info {stated!r} is no CameraInfo{did_you_mean(stated, known)}; there are: {listed}"
            )
        return known[stated]
    parts = reader.channel.topic.split("/")
    shared = {topic: _num_shared(parts, topic.split("/")) for topic in known}
    nearest = [topic for topic, num in shared.items() if num == max(shared.values())]
    if len(nearest) != 1:
        listed = f"which of {', '.join(sorted(nearest))}" if nearest else "the log has none"
        raise ConfigError(
            f"{where}: pixels are directions only by a camera's CameraInfo, and nothing says {listed}; give camera_info"
        )
    return known[nearest[0]]


def _num_shared(one: Sequence[str], other: Sequence[str]) -> int:
    """How many parts two topics have in common from the left."""
    for number, (part, of_other) in enumerate(zip(one, other, strict=False)):
        if part != of_other:
            return number
    return min(len(one), len(other))


def _read(log: MissionLog, reader: ChannelReader, channel: Channel) -> Camera:
    """The camera that a channel describes, always alike."""
    where = f"extract.detections, topic {reader.channel.topic}: its camera {channel.topic}"
    found: Camera | None = None
    try:
        decode = decoder_for(channel)
        for raw in log.messages({channel.topic}):
            camera = _camera(decode(raw.data), channel.topic, where)
            if found is not None and (camera.focal, camera.centre) != (found.focal, found.centre):
                raise ConfigError(f"{where} changes its focal length or centre, as where it zooms; that is not read")
            found = found or camera
    except (UndecodableChannel, UndecodableMessage) as error:
        raise ConfigError(f"{where} cannot be decoded; give another camera_info") from error
    if found is None:
        raise ConfigError(f"{where} has no message; give another camera_info")
    return found


def _camera(message: Any, topic: str, where: str) -> Camera:
    """The camera of one message of any version of ROS, which differ in the case of letters."""
    matrix, distortion = _numbers(_field(message, "k")), _numbers(_field(message, "d"))
    if len(matrix) != 9 or not (np.isfinite(matrix).all() and matrix[0] > 0 and matrix[4] > 0):
        raise ConfigError(f"{where} is not calibrated (its matrix K has no focal length); give another camera_info")
    model = str(_field(message, "distortion_model"))
    if distortion.any() and (model != "plumb_bob" or len(distortion) > 5 or not np.isfinite(distortion).all()):
        raise ConfigError(f"{where} has the distortion {model!r} of {len(distortion)} numbers; only plumb_bob of five is known")
    bends = (*distortion.tolist(), 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    header = _field(message, "header")
    return Camera(topic, (matrix[0], matrix[4]), (matrix[2], matrix[5]), bends, str(_field(header, "frame_id")).lstrip("/"))


def _numbers(value: Any) -> Float64s:
    """Numbers of an array; none where it is none."""
    try:
        return np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        return np.zeros(0)


def _field(message: Any, name: str) -> Any:
    for key in (name, name.upper()):
        found = message.get(key) if isinstance(message, Mapping) else getattr(message, key, None)
        if found is not None:
            return found
    return ""
