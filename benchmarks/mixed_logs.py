"""A log as a robot records it: ten topics of ROS 2 messages (CDR), zstd, most bytes in images and point clouds.

The same size gives the same bytes.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

START_NS = 1_700_000_000_000_000_000
RATES_HZ = {
    "/imu": 200, "/odom": 100, "/tf": 100, "/cmd": 50, "/pose": 50, "/detections": 20, "/fix": 10, "/image": 10, "/points": 10,
    "/diagnostics": 5,
}  # fmt: skip
TYPES = {
    "/imu": "sensor_msgs/msg/Imu", "/odom": "nav_msgs/msg/Odometry", "/tf": "tf2_msgs/msg/TFMessage",
    "/cmd": "geometry_msgs/msg/TwistStamped", "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/detections": "geometry_msgs/msg/PoseArray", "/fix": "sensor_msgs/msg/NavSatFix",
    "/image": "sensor_msgs/msg/CompressedImage", "/points": "sensor_msgs/msg/PointCloud2",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}  # fmt: skip
MB_A_SECOND = 0.80
"""What a second of such a log takes on disk."""
_IMAGE_BYTES, _CLOUD_BYTES = 35_000, 40_000
_NOISE_BYTES = 2**26


def write_mixed_log(path: Path, size_mb: float, distinct_s: float = float("inf")) -> int:
    """Write a log of about `size_mb` (10^6 bytes); the number of its messages. 300 MB are about 208 000 messages.

    What the messages say is repeated after `distinct_s`: large logs are written faster.
    """
    num_written = 0
    maker = _Maker()
    made: dict[int, list[tuple[str, bytes]]] = {}
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2**20)
        writer.start(profile="ros2", library="mixed log")
        channels = {}
        for topic, name in TYPES.items():
            text = maker.store.generate_msgdef(name, ros_version=2)[0]
            channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(name, "ros2msg", text.encode()))
        for tick in range(round(size_mb / MB_A_SECOND * max(RATES_HZ.values()))):
            time_ns = START_NS + tick * 10**9 // max(RATES_HZ.values())
            place = tick if distinct_s == float("inf") else tick % round(distinct_s * max(RATES_HZ.values()))
            messages = made.get(place) or list(maker.messages(tick, time_ns))
            if distinct_s < float("inf"):
                made[place] = messages
            for topic, data in messages:
                writer.add_message(channels[topic], time_ns, data, time_ns - 1000, tick)
                num_written += 1
        writer.finish()
    return num_written


class _Maker:
    """Makes the messages of a moment. Large ones are cut from one stretch of noise, which zstd cannot make smaller."""

    def __init__(self) -> None:
        self.store: Typestore = get_typestore(Stores.ROS2_HUMBLE)
        self.generator = np.random.default_rng(1)
        self.noise = self.generator.integers(0, 256, _NOISE_BYTES, dtype=np.uint8)

    def messages(self, tick: int, time_ns: int) -> Iterator[tuple[str, bytes]]:
        """Topic and bytes of what is due at this tick."""
        for topic, rate in RATES_HZ.items():
            if tick % (max(RATES_HZ.values()) // rate) == 0:
                message = getattr(self, "_" + topic[1:])(self._header(time_ns), self.generator.standard_normal(8))
                yield topic, bytes(self.store.serialize_cdr(message, TYPES[topic]))

    def _make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def _header(self, time_ns: int) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", time_ns // 10**9, time_ns % 10**9)
        return self._make("std_msgs/msg/Header", stamp, "odom")

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x, y, z)

    def _rotation(self, angle: float) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", 0.0, 0.0, float(np.sin(angle)), float(np.cos(angle)))

    def _pose_of(self, draw: Any) -> Any:
        point = self._make("geometry_msgs/msg/Point", *draw[:3])
        return self._make("geometry_msgs/msg/Pose", point, self._rotation(draw[3]))

    def _twist(self, draw: Any) -> Any:
        return self._make("geometry_msgs/msg/Twist", self._vector(*draw[:3]), self._vector(*draw[3:6]))

    def _bytes(self, number: int) -> Any:
        begin = int(self.generator.integers(0, _NOISE_BYTES - number))
        return self.noise[begin : begin + number]

    def _imu(self, header: Any, draw: Any) -> Any:
        covariance = np.full(9, 0.01)
        rotation, rate, acceleration = self._rotation(draw[0]), self._vector(*draw[1:4]), self._vector(*draw[4:7])
        return self._make(TYPES["/imu"], header, rotation, covariance, rate, covariance, acceleration, covariance)

    def _odom(self, header: Any, draw: Any) -> Any:
        covariance = np.full(36, 0.1)
        pose = self._make("geometry_msgs/msg/PoseWithCovariance", self._pose_of(draw), covariance)
        twist = self._make("geometry_msgs/msg/TwistWithCovariance", self._twist(draw), covariance)
        return self._make(TYPES["/odom"], header, "base_link", pose, twist)

    def _tf(self, header: Any, draw: Any) -> Any:
        frames = ("base_link", "camera", "lidar")
        return self._make(TYPES["/tf"], [
            self._make("geometry_msgs/msg/TransformStamped", header, frame,
                       self._make("geometry_msgs/msg/Transform", self._vector(*draw[:3]), self._rotation(draw[3])))
            for frame in frames
        ])  # fmt: skip

    def _cmd(self, header: Any, draw: Any) -> Any:
        return self._make(TYPES["/cmd"], header, self._twist(draw))

    def _pose(self, header: Any, draw: Any) -> Any:
        pose = self._make("geometry_msgs/msg/PoseWithCovariance", self._pose_of(draw), np.full(36, 0.2))
        return self._make(TYPES["/pose"], header, pose)

    def _detections(self, header: Any, draw: Any) -> Any:
        return self._make(TYPES["/detections"], header, [self._pose_of(draw + i) for i in range(3)])

    def _fix(self, header: Any, draw: Any) -> Any:
        status = self._make("sensor_msgs/msg/NavSatStatus", 0, 1)
        return self._make(TYPES["/fix"], header, status, 50 + draw[0] / 1e3, -1 + draw[1] / 1e3, 10.0, np.full(9, 2.0), 2)

    def _image(self, header: Any, draw: Any) -> Any:
        return self._make(TYPES["/image"], header, "jpeg", self._bytes(_IMAGE_BYTES))

    def _points(self, header: Any, draw: Any) -> Any:
        fields = [self._make("sensor_msgs/msg/PointField", name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
        data = self._bytes(_CLOUD_BYTES)
        return self._make(TYPES["/points"], header, 1, len(data) // 16, fields, False, 16, len(data), data, True)

    def _diagnostics(self, header: Any, draw: Any) -> Any:
        values = [self._make("diagnostic_msgs/msg/KeyValue", f"value {i}", f"{x:.6f}") for i, x in enumerate(draw)]
        status = self._make("diagnostic_msgs/msg/DiagnosticStatus", b"\x00"[0], "motor", "all is well", "1", values)
        return self._make(TYPES["/diagnostics"], header, [status])
