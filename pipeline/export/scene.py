"""foxglove.SceneUpdate as bytes, straight from arrays.

Hundreds of lines a tick, thousands of points: building them as protobuf objects costs tens of milliseconds a message. All
lines of a group have the same number of points, so every one of them has the same length on the wire: one is encoded with
zeros, repeated, and numpy puts all numbers into their places at once. Fields are in the order of their numbers, so that the
bytes equal those of the reference classes wherever these write a number at all (they leave out zeros; both parse to the same
message).
"""

import functools
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from cadence.arrays import Float64s, Floats
from pipeline.logs.wire import DOUBLE, field, varint


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


def round_positions(position_m: Floats, reach_m: float) -> Float64s:
    """Positions on a grid of a metre for a drawing a kilometre wide, finer and coarser in proportion (powers of two).

    The eye cannot tell, and the zero bits at the end of every number compress well.
    """
    quantum = 2.0 ** np.round(np.log2(max(reach_m, 1e-6) / 1024.0))
    # Adding zero turns -0.0 into 0.0.
    rounded: Float64s = np.round(np.asarray(position_m, np.float64) / quantum) * quantum + 0.0
    return rounded


def _encode_lines(lines: Lines) -> bytes:
    """Repeated LinePrimitive (field 11 of SceneEntity)."""
    num_lines, num_points = lines.point_m.shape[:2]
    if not num_lines or not num_points:
        return b""
    # The z of a flat scene is zero, and zero is not written.
    axes = 3 if lines.point_m[..., 2].any() else 2
    template, first_point, first_channel = _line_template(num_points, axes, lines.type, lines.thickness_px)
    wire, line = bytearray(template * num_lines), len(template)
    _numbers(wire, first_point, (num_lines, num_points, axes), (line, 2 + 9 * axes, 9))[...] = lines.point_m[..., :axes]
    _numbers(wire, first_channel, (num_lines, 4), (line, 9))[...] = lines.color
    return bytes(wire)


@functools.lru_cache(maxsize=1024)
def _line_template(num_points: int, axes: int, kind: LineType, thickness_px: float) -> tuple[bytes, int, int]:
    """One line on the wire with zeros for its numbers, and where the first coordinate and the first channel of colour stand."""
    before = (b"\x08" + bytes([kind]) if kind else b"") + field(2, _IDENTITY_POSE)
    before += b"\x19" + struct.pack("<d", thickness_px) + b"\x20\x01"  # scale_invariant
    points = field(5, _doubles((0.0,) * axes)) * num_points
    content = before + points + field(6, _doubles((0.0,) * 4))
    template = field(11, content)
    begin = len(template) - len(content) + len(before)
    return template, begin + 3, begin + len(points) + 3


def _encode_spheres(spheres: Spheres) -> bytes:
    """Repeated SpherePrimitive (field 9 of SceneEntity)."""
    num_spheres = len(spheres.center_m)
    if not num_spheres:
        return b""
    template, first_axis = _sphere_template(spheres.diameter_m, tuple(spheres.color.tolist()))
    wire = bytearray(template * num_spheres)
    _numbers(wire, first_axis, (num_spheres, 3), (len(template), 9))[...] = spheres.center_m
    return bytes(wire)


@functools.lru_cache(maxsize=64)
def _sphere_template(diameter_m: float, color: tuple[float, ...]) -> tuple[bytes, int]:
    """One sphere at zero on the wire, and where its first coordinate stands."""
    pose = field(1, _doubles((0.0, 0.0, 0.0))) + _IDENTITY_POSE
    content = field(1, pose) + field(2, _doubles((diameter_m,) * 3)) + field(3, _doubles(color))
    template = field(9, content)
    return template, len(template) - len(content) + 5


def _encode_label(label: Label) -> bytes:
    """TextPrimitive (field 13 of SceneEntity), 14 pixels high."""
    pose = field(1, _doubles(label.position_m.tolist())) + _IDENTITY_POSE
    body = field(1, pose) + b"\x10\x01" + b"\x19" + struct.pack("<d", 14.0) + b"\x20\x01"
    return field(13, body + field(5, _doubles(label.color.tolist())) + field(6, label.text.encode()))


def _doubles(value: Sequence[float]) -> bytes:
    """A message of doubles alone, numbered from 1: Vector3, Point3, Color."""
    return b"".join(struct.pack("<Bd", number << 3 | DOUBLE, one) for number, one in enumerate(value, start=1))


def _numbers(wire: bytearray, offset: int, shape: tuple[int, ...], strides: tuple[int, ...]) -> Float64s:
    """The doubles that stand at equal distances in `wire`, to be assigned to."""
    return np.ndarray(shape, "<f8", wire, offset, strides)


_IDENTITY_POSE = field(2, b"\x21" + struct.pack("<d", 1.0))  # Pose with orientation w = 1
