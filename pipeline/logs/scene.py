"""foxglove.SceneUpdate as bytes, straight from arrays.

Hundreds of lines a tick, thousands of points: building them as protobuf objects costs tens of milliseconds a message. All
lines of a group have the same number of points, so every one of them has the same length on the wire: numpy fills a
structured array whose items *are* the wire format. Fields are in the order of their numbers, so that the bytes equal those
of the reference classes wherever these write a number at all (they leave out zeros; both parse to the same message).
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from pipeline.logs.wire import BYTES, DOUBLE, field, varint

Floats = npt.NDArray[np.floating]

_POINT = 5 << 3 | BYTES


class LineType(IntEnum):
    """foxglove.LinePrimitive.Type."""

    STRIP = 0
    LOOP = 1
    LIST = 2


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines that look alike.

    point_m [L, V, 3] metres; color [L, 4] red, green, blue, alpha in 0..1; thickness_px on the screen, whatever the zoom
    """

    point_m: Floats
    color: Floats
    thickness_px: float
    type: LineType = LineType.STRIP


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres at center_m [N, 3] with one diameter and colour (red, green, blue, alpha)."""

    center_m: Floats
    diameter_m: float
    color: Floats


@dataclass(frozen=True, eq=False)
class Label:
    """A text that always faces the viewer."""

    position_m: Floats
    text: str
    color: Floats


@dataclass(frozen=True)
class Entity:
    """One named thing in the scene; a later message with the same id replaces it."""

    id: str
    lines: tuple[Lines, ...] = ()
    spheres: tuple[Spheres, ...] = ()
    labels: tuple[Label, ...] = ()


def encode_scene(time_ns: int, frame_id: str, entities: Iterable[Entity]) -> bytes:
    """A self-contained SceneUpdate: everything before is deleted, `entities` are all there is."""
    timestamp = encode_time(time_ns)
    deletion = field(1, timestamp) + b"\x10\x01"  # type = ALL
    body = [field(1, deletion)]
    head = field(1, timestamp) + field(2, frame_id.encode())
    for entity in entities:
        parts = [head, field(3, entity.id.encode())]
        parts += [_encode_spheres(spheres) for spheres in entity.spheres]
        parts += [_encode_lines(lines) for lines in entity.lines]
        parts += [_encode_label(label) for label in entity.labels]
        body.append(field(2, b"".join(parts)))
    return b"".join(body)


def encode_time(time_ns: int) -> bytes:
    """google.protobuf.Timestamp without its tag."""
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return (b"\x08" + varint(seconds) if seconds else b"") + (b"\x10" + varint(nanos) if nanos else b"")


def round_positions(position_m: Floats, extent_m: float) -> npt.NDArray[np.float64]:
    """Positions on a grid of 1/16 m for a scene a kilometre wide, finer and coarser in proportion (powers of two).

    The eye cannot tell, and the zero bits at the end of every number compress well.
    """
    quantum = 2.0 ** np.round(np.log2(max(extent_m, 1e-6) / 16384.0))
    # Adding zero turns -0.0 into 0.0.
    rounded: npt.NDArray[np.float64] = np.round(np.asarray(position_m, np.float64) / quantum) * quantum + 0.0
    return rounded


def _encode_lines(lines: Lines) -> bytes:
    """Repeated LinePrimitive (field 11 of SceneEntity)."""
    num_lines, num_points = lines.point_m.shape[:2]
    if not num_lines or not num_points:
        return b""
    # The z of a flat scene is zero, and zero is not written.
    axes = 3 if np.any(lines.point_m[..., 2]) else 2
    point = np.dtype([("head", "u1", (2,)), ("axis", [("tag", "u1"), ("value", "<f8")], (axes,))])
    before = (b"\x08" + bytes([lines.type]) if lines.type else b"") + field(2, _IDENTITY_POSE)
    before += b"\x19" + struct.pack("<d", lines.thickness_px) + b"\x20\x01"  # scale_invariant
    length = len(before) + num_points * point.itemsize + 2 + _COLOR.itemsize
    prefix = b"\x5a" + varint(length) + before
    line = np.dtype(
        [("prefix", "u1", (len(prefix),)), ("points", point, (num_points,)), ("head", "u1", (2,)), ("color", _COLOR)]
    )
    wire = np.empty(num_lines, dtype=line)
    wire["prefix"] = np.frombuffer(prefix, np.uint8)
    wire["points"]["head"] = (_POINT, point.itemsize - 2)
    wire["points"]["axis"]["tag"] = (0x09, 0x11, 0x19)[:axes]
    wire["points"]["axis"]["value"] = lines.point_m[..., :axes]
    wire["head"] = (0x32, _COLOR.itemsize)
    _fill_color(wire["color"], lines.color)
    return wire.tobytes()


def _encode_spheres(spheres: Spheres) -> bytes:
    """Repeated SpherePrimitive (field 9 of SceneEntity)."""
    if not len(spheres.center_m):
        return b""
    axis = [("tag", "u1"), ("value", "<f8")]
    size, color = _vector(np.full(3, spheres.diameter_m)), np.zeros(1, _COLOR)
    _fill_color(color, spheres.color[None])
    after = field(2, size) + field(3, color.tobytes())
    pose = 2 + 27 + len(_IDENTITY_POSE)
    prefix = b"\x4a" + varint(2 + pose + len(after)) + bytes([0x0A, pose, 0x0A, 27])
    sphere = np.dtype(
        [("prefix", "u1", (len(prefix),)), ("axis", axis, (3,)), ("after", "u1", (len(_IDENTITY_POSE) + len(after),))]
    )
    wire = np.empty(len(spheres.center_m), dtype=sphere)
    wire["prefix"] = np.frombuffer(prefix, np.uint8)
    wire["axis"]["tag"] = (0x09, 0x11, 0x19)
    wire["axis"]["value"] = spheres.center_m
    wire["after"] = np.frombuffer(_IDENTITY_POSE + after, np.uint8)
    return wire.tobytes()


def _encode_label(label: Label) -> bytes:
    """TextPrimitive (field 13 of SceneEntity), 14 pixels high."""
    color = np.zeros(1, _COLOR)
    _fill_color(color, label.color[None])
    pose = field(1, _vector(label.position_m)) + _IDENTITY_POSE
    body = field(1, pose) + b"\x10\x01" + b"\x19" + struct.pack("<d", 14.0) + b"\x20\x01"
    return field(13, body + field(5, color.tobytes()) + field(6, label.text.encode()))


def _vector(value: Floats) -> bytes:
    """Vector3 or Point3."""
    return b"".join(bytes([number << 3 | DOUBLE]) + struct.pack("<d", float(value[number - 1])) for number in (1, 2, 3))


_IDENTITY_POSE = field(2, b"\x21" + struct.pack("<d", 1.0))  # Pose with orientation w = 1

_COLOR = np.dtype([("channel", [("tag", "u1"), ("value", "<f8")], (4,))])


def _fill_color(wire: npt.NDArray[np.void], color: Floats) -> None:
    wire["channel"]["tag"] = (0x09, 0x11, 0x19, 0x21)
    wire["channel"]["value"] = color
