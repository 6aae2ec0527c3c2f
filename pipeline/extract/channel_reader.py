"""Messages → columns of positions: which source reads which channel, and what each of its messages says.

What cannot be used is counted, never passed on in silence.
"""

import json
import math
from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from cadence.arrays import Float64s
from cadence.errors import ConfigError
from pipeline.arrays import Column
from pipeline.extract.columns import FieldColumns, mapped
from pipeline.extract.covariances import (
    NONE_COVARIANCE,
    Covariance,
    isotropic,
    stated_covariance,
    stated_covariances,
    stated_sigma,
)
from pipeline.extract.field_reader import FieldReader
from pipeline.extract.positions import Positions, Rows
from pipeline.extract.stamps import stamp_ns
from pipeline.extract.validity import Conditions
from pipeline.logs.channels import Batch
from pipeline.logs.decode import UndecodableChannel
from pipeline.logs.reader import Channel, RawMessage
from pipeline.mapping.message_path import Place, at_place
from pipeline.mapping.message_type import VerticalDatum
from pipeline.mapping.sources import LOG_TIME, PATH_KEYS, PUBLISH_TIME, SourceConfig, resolve_paths

Point = tuple[Place, Any, Any, Any]
"""Place in the message; x, y and z, or latitude, longitude and altitude, as the message has them."""


class ChannelReader:
    """Reads one channel for one source. `named` holds what the topic says: agent, sensor."""

    def __init__(self, channel: Channel, source: SourceConfig, role: str, is_stated: bool, named: Mapping[str, str]) -> None:
        paths = resolve_paths(source, channel.schema_name)
        self.channel, self.source, self.role, self.is_stated = channel, source, role, is_stated
        if paths.is_polar and role != "detections":
            raise ConfigError(f"extract.{role}, topic {channel.topic}: ranges and bearings are detections; name other topics")
        self.paths, self.is_polar, self.is_geodetic = paths, paths.is_polar, bool(paths.latitude)
        self.names = {"agent": named.get("agent", source.agent), "sensor": named.get("sensor", source.sensor)}
        self.is_camera, self.has_observer = bool(paths.pixel_x), bool(source.observer_place or paths.observer)
        names = _PIXELS if self.is_camera else _POLAR if self.is_polar else _GEODETIC if self.is_geodetic else _METRIC
        alternatives = [getattr(paths, name) for name in names]
        self.alternatives, self.json_text = paths.alternatives, paths.json_text
        if self.alternatives == "first":
            self.positions = [tuple(self._field(name, texts) for name, texts in zip(names, alternatives, strict=True))]
        else:
            self.positions = [
                tuple(self._field(name, (text,)) for name, text in zip(names, texts, strict=True))
                for texts in zip(*alternatives, strict=True)
            ]
        self.more = MEASURED if self.is_polar else ORIGIN if paths.origin_latitude else AXES if paths.axes else ()
        fields = {name: self._field(name, getattr(paths, name)) for name in (*_OTHERS, *self.more)}
        self.fields = {name: reader for name, reader in fields.items() if reader.paths}
        self.conditions = Conditions(paths.where, source.where is not None)
        self.vertical_datum: VerticalDatum = paths.vertical_datum
        if self.vertical_datum == "not stated" and not self.is_geodetic:
            self.vertical_datum = "frame"
        self.is_ned, self.is_north_first = paths.frame_convention == "ned", paths.is_north_first
        self.unknown = NONE_COVARIANCE if source.sigma_m is None else isotropic(source.sigma_m**2)
        self.rows, self._measured = Rows(), array("d")
        self.counts: Counter[str] = Counter()

    def _field(self, name: str, paths: Sequence[str]) -> FieldReader:
        """Fields that a constant replaces have no path; those that the user stated must be in some message."""
        if self.names.get(name) is not None:
            return FieldReader(())
        if name == "time" and self.source.time in (LOG_TIME, PUBLISH_TIME):
            return FieldReader(())
        is_stated = getattr(self.source, PATH_KEYS.get(name, name), None) is not None
        is_position = name in _NEEDED and self.source.message_type is not None and self.is_stated
        return FieldReader(paths, bool(paths) and (is_stated or is_position), _CONVERSIONS.get(name))

    def read(self, message: Any, raw: RawMessage) -> None:
        """Append the positions of one decoded message, or count why there are none."""
        self.counts["messages"] += 1
        if self.json_text:
            message = _opened(message, self.json_text)
        points = self._points(message)
        if points is None:
            self.counts["incomplete"] += 1
            return
        found = [(name, located) for name, reader in self.fields.items() if (located := reader.located(message))]
        conditions = self.conditions.located(message)
        default_ns = raw.publish_time_ns if self.source.time == PUBLISH_TIME else raw.log_time_ns
        for place, first, second, z in points:
            if not self.conditions.hold_at(conditions, place):
                self.counts[self._unmet] += 1
                continue
            values: dict[str, Any] = dict.fromkeys(_OTHERS)
            for name, located in found:
                values[name] = located[place] if place in located else at_place(located, place)
            covariance = self._covariance(values["covariance"], values["covariance_type"], values["sigma"])
            self.counts["text"] += isinstance(first, str) and math.isnan(_number(first))
            time_ns = default_ns if values["time"] is None else values["time"]
            self.rows.integers.extend((time_ns, raw.log_time_ns, raw.sequence, self.counts["messages"]))
            self.rows.floats.extend((_number(first), _number(second), _number(z), _number(values["score"]), *covariance))
            if self.more:
                self._measured.extend(_number(values.get(name)) for name in self.more)
            self.rows.agents.append(self._identity("agent", values["agent"], place))
            self.rows.sensors.append(self._identity("sensor", values["sensor"], place))
            self.rows.frame_ids.append(values["frame_id"] or "")

    @property
    def what(self) -> tuple[str, ...]:
        """What it reads: the paths of positions, and the conditions on them."""
        paths = [path.text for position in self.positions for field in position for path in field.paths]
        return (*paths, *(term.text for term in self.conditions.terms))

    def field_columns(self) -> FieldColumns:
        """What reads the source's fields of many messages at once; `UndecodableChannel` where that cannot be done."""
        if self.is_polar or self.alternatives != "first" or self.json_text or self.conditions.name_constants:
            raise UndecodableChannel(f"{self.channel.topic}: only a decoded message says what is to be used of it")
        readers = dict(zip(_COLUMNS, self.positions[0], strict=True)) | self.fields
        columns = FieldColumns(self.channel, {name: reader.paths for name, reader in readers.items()} | self.conditions.paths)
        needed = {"first", "second"} | {name for name, reader in readers.items() if reader.is_needed}
        if not needed | (set(self.conditions.paths) if self.conditions.is_stated else set()) <= columns.names:
            raise UndecodableChannel(f"{self.channel.topic}: lacks a field")
        return columns

    def read_columns(self, columns: Mapping[str, Column], batch: Batch) -> None:
        """Append what `field_columns` read of a batch: rows and counts are those of `read`, one message after the other."""
        message = self.counts["messages"] + 1 + np.arange(len(batch))
        self.counts["messages"] += len(batch)
        for name, reader in zip((*_COLUMNS, *self.fields), (*self.positions[0], *self.fields.values()), strict=True):
            reader.is_found = reader.is_found or name in columns
        is_used = self.conditions.hold_in(columns, len(batch))
        num_rows = int(is_used.sum())
        self.counts[self._unmet] += len(batch) - num_rows
        columns = {name: column[is_used] for name, column in columns.items()}
        log_time_ns, sequence = batch.log_time_ns[is_used], batch.sequence[is_used]
        time_ns = batch.publish_time_ns[is_used].astype(np.int64) if self.source.time == PUBLISH_TIME else log_time_ns
        if "time" in columns:
            time_ns = np.where(columns["time"] == 0, time_ns, columns["time"])
        absent = np.full(num_rows, math.nan)
        numbers = [columns.get(name, absent) for name in (*_COLUMNS, "score")]
        self.rows.integers.frombytes(
            np.column_stack([time_ns, log_time_ns, sequence, message[is_used]]).astype(np.int64).tobytes()
        )
        self.rows.floats.frombytes(np.column_stack([*numbers, self._covariances(columns, num_rows)]).tobytes())
        if self.more:
            more = [columns.get(name, absent) for name in self.more]
            self._measured.frombytes(np.column_stack(more).astype(np.float64).tobytes())
        for kind, names in (("agent", self.rows.agents), ("sensor", self.rows.sensors)):
            stated = columns[kind].tolist() if kind in columns else [None] * num_rows
            names += mapped(stated, partial(self._identity, kind, place=()))
        frames = columns["frame_id"].tolist() if "frame_id" in columns else [""] * num_rows
        self.rows.frame_ids += mapped(frames, lambda name: _frame_name(name) or "")

    def check(self) -> None:
        """`ConfigError` where something that the user stated was in no message."""
        alternatives = [(reader,) for reader in self.fields.values()] + list(zip(*self.positions, strict=True))
        if self.is_polar and not self.is_camera:
            either = [alternative for alternative in self.positions[0][:2] if alternative.paths]
            if self.is_stated and self.counts["messages"] and not any(reader.is_found for reader in either):
                where = f"extract.{self.role}, topic {self.channel.topic}"
                lacks = " and ".join(reader.problem for reader in either)
                raise ConfigError(f"{where}: no message has {lacks}; correct the [extract] entry")
        for readers in alternatives:
            if readers[0].is_needed and self.counts["messages"] and not any(reader.is_found for reader in readers):
                where = f"extract.{self.role}, topic {self.channel.topic}"
                raise ConfigError(f"{where}: no message has {readers[0].problem}; correct the [extract] entry")
        if self.conditions.is_stated and self.conditions.missing and self.counts["messages"] > self.counts["incomplete"]:
            where = f"extract.{self.role}, topic {self.channel.topic}"
            raise ConfigError(f"{where}: no message has {self.conditions.missing}; correct `where` in the [extract] entry")

    def measured(self) -> Mapping[str, Float64s]:
        """Of all rows read [N] what messages state beside the position (`more`), else NaN."""
        columns = np.array(self._measured, dtype=np.float64).reshape(-1, max(1, len(self.more))).T
        return dict(zip(self.more, columns, strict=False))

    def finish(self) -> Positions:
        """All rows read; of ranges and bearings range, bearing and elevation are x, y and z (see `polar`)."""
        rows = self.rows.finish(self.channel.topic, self.is_geodetic, self.is_ned, self.is_stated)
        if not self.is_north_first:
            return rows
        covariance_m2, height_covariance_m2 = rows.covariance_m2[:, [2, 1, 0]], rows.height_covariance_m2[:, [1, 0, 2]]
        return rows.changed(covariance_m2=covariance_m2, height_covariance_m2=height_covariance_m2)

    @property
    def _unmet(self) -> str:
        """How positions are counted that the conditions leave out."""
        return "unmet" if self.conditions.is_stated else "no_fix"

    def _points(self, message: Any) -> list[Point] | None:
        """All positions in a message; None where no path leads to any."""
        found = [points for position in self.positions if (points := self._joined(position, message)) is not None]
        if len(found) < 2:
            return found[0] if found else None
        if self.alternatives == "all":
            return [point for points in found for point in points]
        filled = {point[0]: point for points in reversed(found) for point in points if _is_filled(point)}
        return [filled.get(point[0], point) for point in found[0]]

    def _joined(self, position: Sequence[FieldReader], message: Any) -> list[Point] | None:
        """The items that have both of the first two coordinates; the others are counted."""
        if not (position[0].paths and position[1].paths):
            return self._alone(position, message)
        firsts, seconds = position[0].located(message), position[1].located(message)
        if firsts is None or seconds is None:
            return None if not self.is_polar else self._alone(position, message)
        zs = position[2].located(message) or {}
        points = [(place, first, seconds[place], at_place(zs, place)) for place, first in firsts.items() if place in seconds]
        self.counts["incomplete"] += len(firsts.keys() | seconds.keys()) - len(points)
        return points

    def _alone(self, position: Sequence[FieldReader], message: Any) -> list[Point] | None:
        """The items of ranges without bearings, or of bearings without ranges."""
        ranges, bearings, zs = (reader.located(message) or {} for reader in position)
        return [
            (place, ranges.get(place), bearings.get(place), at_place(zs, place)) for place in {**ranges, **bearings}
        ] or None

    def _covariance(self, matrix: Any, kind: Any, sigma_m: Any) -> Covariance:
        """What is unknown takes the stated accuracy, else the source's sigma_m; so does what is none, which is counted."""
        if matrix is not None:
            says_something = kind != 0 and not (isinstance(kind, str) and "UNKNOWN" in kind)
            try:
                if (stated := stated_covariance(matrix)) is not None and says_something:
                    return stated
                self.counts["disowned_covariance"] += stated is not None
            except (LookupError, TypeError, ValueError, OverflowError):
                self.counts["bad_covariance"] += says_something
        return stated_sigma(_number(sigma_m)) or self.unknown

    def _covariances(self, columns: Mapping[str, Column], num_rows: int) -> Float64s:
        """`_covariance` [N, 6] of many messages at once."""
        unknown = np.tile(np.array(self.unknown), (num_rows, 1))
        if "sigma" in columns:
            stated = [stated_sigma(sigma_m) or self.unknown for sigma_m in columns["sigma"].tolist()]
            unknown = np.array(stated, np.float64).reshape(-1, 6)
        if "covariance" not in columns:
            return unknown
        covariances, is_stated, is_bad = stated_covariances(columns["covariance"])
        says_something = columns["covariance_type"] != 0 if "covariance_type" in columns else np.ones(num_rows, np.bool_)
        self.counts["bad_covariance"] += int((is_bad & says_something).sum())
        self.counts["disowned_covariance"] += int((is_stated & ~says_something).sum())
        return np.where((is_stated & says_something)[:, None], covariances, unknown)

    def _identity(self, kind: str, value: Any, place: Place) -> str | None:
        """Constant, from a field, or None; truth and poses need a name, so theirs is at last the topic's (and the place)."""
        if kind == "agent" and self.role == "detections" and self.source.has_identity is False:
            return None
        constant = self.names[kind]
        name = _name(value if constant is None else constant)
        if name is not None or kind != {"truth": "agent", "poses": "sensor"}.get(self.role):
            return name
        topic = self.channel.topic.strip("/") or self.role
        return "/".join([topic, *map(str, place)])


def _frame_name(value: Any) -> str | None:
    return value.lstrip("/") or None if isinstance(value, str) else None  # ROS 1 wrote /map


_COLUMNS = ("first", "second", "z")
_METRIC = ("x", "y", "z")
_GEODETIC = ("latitude", "longitude", "altitude")
_PIXELS = ("range", "pixel_x", "pixel_y")
_POLAR = ("range", "bearing", "elevation")
MEASURED = (
    "range_rate", "range_sigma", "bearing_sigma", "elevation_sigma", "range_rate_sigma", "box_width", "box_height",
)  # fmt: skip
"""What sources of ranges and bearings, or of pixels, may state beside these."""
ORIGIN = ("origin_latitude", "origin_longitude")
"""Where on the earth metres count from."""
AXES = ("axes",)
"""Whether x, y and z are along the axes that the type has by convention."""
_NEEDED = ("x", "y", "latitude", "longitude", "pixel_x", "pixel_y")
"""Of a type, every one; of range and bearing one is enough: a direction finder has no ranges."""
_OTHERS = ("covariance", "covariance_type", "sigma", "time", "frame_id", "agent", "sensor", "score")
_CONVERSIONS: Mapping[str, Callable[[Any], Any]] = {"time": stamp_ns, "frame_id": _frame_name}


def _opened(message: Any, name: str) -> Any:
    """What the text of a field says, which is JSON; nothing where it is none."""
    try:
        return json.loads(message[name] if isinstance(message, dict) else getattr(message, name))
    except (KeyError, AttributeError, TypeError, ValueError, RecursionError):
        return {}


def _number(value: Any) -> float:
    """A float; NaN for what is no number."""
    if value is None:
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _is_filled(point: Point) -> bool:
    return any(point[1:]) and not any(math.isnan(_number(value)) for value in point[1:3])


_NO_NAMES = {"", "-1", "none", "null", "nil", "nan", "n/a", "unknown", "unidentified", "undefined"}
"""How messages and topics say that there is no identity."""


_UUID_BYTES = 16
"""Of 16 bytes without a name of their own, text fills all, or has nothing but zeros behind it."""


def _name(value: Any) -> str | None:
    """An identity as text; None for none. UUIDs as bytes or numbers become hexadecimal."""
    if value is None:
        return None
    if isinstance(value, str | int):
        text = _unpadded(str(value))
        return None if text.lower() in _NO_NAMES else text
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    inner = value.get("uuid", value) if isinstance(value, dict) else getattr(value, "uuid", value)
    try:
        octets = bytes(inner)
    except (TypeError, ValueError):
        return str(inner)
    letters = _letters(octets) if inner is value else None
    return octets.hex() if letters is None else _name(letters)


def _unpadded(text: str) -> str:
    """The text without what fills its field up: spaces, what stands behind a zero byte, the @ of AIS."""
    return text.partition("\0")[0].rstrip("@").strip()


def _letters(octets: bytes) -> str | None:
    """The text in an array of characters; None where the bytes are none."""
    text, _, rest = octets.partition(b"\0")
    is_text = text.isascii() and text.decode("latin-1").isprintable()
    return text.decode() if is_text and text and not (len(octets) == _UUID_BYTES and any(rest)) else None
