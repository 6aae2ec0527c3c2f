"""Decoded messages → columns of positions: which source reads which channel, and what each of its messages says.

One pass over the log serves all roles. What cannot be used is counted, never passed on in silence.
"""

import math
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from cadence.errors import ConfigError
from pipeline.logs.decode import Decoder, UndecodableChannel, UndecodableMessage, decoder_for
from pipeline.logs.reader import Channel, MissionLog, RawMessage
from pipeline.message_path import MissingFieldError, parse_path
from pipeline.progress import Progress
from pipeline.sources import LOG_TIME, PATH_KEYS, PUBLISH_TIME, SourceConfig, resolve_paths
from pipeline.stamps import stamp_ns

Float64s = npt.NDArray[np.float64]
Objects = npt.NDArray[np.object_]

NONE_COVARIANCE = (math.nan, math.nan, math.nan)


@dataclass(frozen=True, eq=False)
class Positions:
    """Columns of N rows. NaN and None stand for what a message does not state.

    first, second  x_m and y_m, or latitude_deg and longitude_deg where is_geodetic
    covariance_m2  [N, 3] xx, xy, yy (east and north)
    is_stated      whether the user configured the source (else it was suggested)
    """

    time_ns: npt.NDArray[np.int64]
    log_time_ns: npt.NDArray[np.int64]
    sequence: npt.NDArray[np.int64]
    first: Float64s
    second: Float64s
    z_m: Float64s
    covariance_m2: Float64s
    score: npt.NDArray[np.float32]
    agent: Objects
    sensor: Objects
    topic: Objects
    frame_id: Objects
    is_geodetic: npt.NDArray[np.bool_]
    is_stated: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, rows: Any) -> Self:
        """The rows of a mask, of indices or of a slice."""
        return type(self)(*(getattr(self, item.name)[rows] for item in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence["Positions"]) -> "Positions":
        """All rows of `parts`, in order."""
        return cls(*(np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(cls)))


class Rows:
    """Growing columns of one reader (`Positions` once complete)."""

    def __init__(self) -> None:
        self.integers = array("q")  # time, log time, sequence
        self.floats = array("d")  # first, second, z, xx, xy, yy, score
        self.agents: list[str | None] = []
        self.sensors: list[str | None] = []
        self.frame_ids: list[str] = []

    def finish(self, topic: str, is_geodetic: bool, is_stated: bool) -> Positions:
        """The columns as arrays."""
        integers = np.array(self.integers, dtype=np.int64).reshape(-1, 3)
        floats = np.array(self.floats, dtype=np.float64).reshape(-1, 7)
        num_rows = len(integers)
        return Positions(
            integers[:, 0], integers[:, 1], integers[:, 2],
            floats[:, 0], floats[:, 1], floats[:, 2], floats[:, 3:6], floats[:, 6].astype(np.float32),
            np.array(self.agents, dtype=object), np.array(self.sensors, dtype=object),
            np.full(num_rows, topic, dtype=object), np.array(self.frame_ids, dtype=object),
            np.full(num_rows, is_geodetic), np.full(num_rows, is_stated),
        )  # fmt: skip


class FieldReader:
    """Alternative message paths of one field; remembers the first that a message had."""

    def __init__(self, texts: Iterable[str], is_needed: bool = False) -> None:
        self.paths = [parse_path(text) for text in texts]
        self.is_needed = is_needed
        self.found: int | None = None
        self.problem = ""

    def values(self, message: Any) -> list[Any] | None:
        """The values, one or one an item; None where no alternative leads anywhere."""
        if self.found is not None:
            try:
                return self.paths[self.found].values(message)
            except MissingFieldError:
                pass
        for place, path in enumerate(self.paths):
            try:
                values = path.values(message)
            except MissingFieldError as error:
                self.problem = f"path {path.text!r}: {error}"
                continue
            self.found = place
            return values
        return None


class ChannelReader:
    """Reads one channel for one source. `named` holds what the topic says: agent, sensor."""

    def __init__(self, channel: Channel, source: SourceConfig, role: str, is_stated: bool, named: Mapping[str, str]) -> None:
        paths = resolve_paths(source, channel.schema_name)
        self.channel, self.source, self.role, self.is_stated = channel, source, role, is_stated
        self.is_geodetic = bool(paths.latitude)
        self.names = {"agent": named.get("agent", source.agent), "sensor": named.get("sensor", source.sensor)}
        self.fields = {item.name: self._field(item.name, getattr(paths, item.name)) for item in fields(paths)}
        self.position = tuple(self.fields[name] for name in (_GEODETIC if self.is_geodetic else _METRIC))
        self.sigma = NONE_COVARIANCE if source.sigma_m is None else (source.sigma_m**2, 0.0, source.sigma_m**2)
        self.rows = Rows()
        self.counts: Counter[str] = Counter()

    def _field(self, name: str, paths: Sequence[str]) -> FieldReader:
        """Fields that a constant replaces have no path; those that the user stated must be in some message."""
        if name == "schemas" or self.names.get(name) is not None:
            return FieldReader(())
        if name == "time" and self.source.time in (LOG_TIME, PUBLISH_TIME):
            return FieldReader(())
        is_stated = getattr(self.source, PATH_KEYS.get(name, name), None) is not None
        is_position = name in ("x", "y", "latitude", "longitude") and self.source.preset is not None and self.is_stated
        return FieldReader(paths, is_needed=bool(paths) and (is_stated or is_position))

    def read(self, message: Any, raw: RawMessage) -> None:
        """Append the positions of one decoded message, or count why there are none."""
        self.counts["messages"] += 1
        firsts, seconds = self.position[0].values(message), self.position[1].values(message)
        if firsts is None or seconds is None or len(firsts) != len(seconds):
            self.counts["incomplete"] += 1
            return
        num = len(firsts)
        try:
            columns = zip(
                firsts, seconds, self._spread(self.position[2], message, num), self._covariances(message, num),
                self._spread(self.fields["score"], message, num), self._times(message, raw, num),
                self._names(message, num, "agent"), self._names(message, num, "sensor"),
                self._spread(self.fields["frame_id"], message, num), self._spread(self.fields["status"], message, num),
                strict=True,
            )  # fmt: skip
        except _LengthError:
            self.counts["incomplete"] += 1
            return
        for first, second, z, covariance, score, time_ns, agent, sensor, frame_id, status in columns:
            if status is not None and _number(status) < 0:
                self.counts["no_fix"] += 1
                continue
            self.rows.integers.extend((time_ns, raw.log_time_ns, raw.sequence))
            self.rows.floats.extend((_number(first), _number(second), _number(z), *covariance, _number(score)))
            self.rows.agents.append(agent)
            self.rows.sensors.append(sensor)
            self.rows.frame_ids.append(frame_id.lstrip("/") if isinstance(frame_id, str) else "")  # ROS 1 wrote /map

    def check(self) -> None:
        """`ConfigError` where something that the user stated was in no message."""
        for reader in self.fields.values():
            if reader.is_needed and reader.found is None and self.counts["messages"]:
                where = f"extract.{self.role}, topic {self.channel.topic}"
                raise ConfigError(f"{where}: no message has {reader.problem}; correct the [extract] entry")

    def finish(self) -> Positions:
        """All rows read."""
        return self.rows.finish(self.channel.topic, self.is_geodetic, self.is_stated)

    def _spread(self, reader: FieldReader, message: Any, num: int) -> list[Any]:
        values = reader.values(message) if reader.paths else None
        if values is None:
            return [None] * num
        if len(values) == num:
            return values
        if len(values) != 1:
            raise _LengthError
        return values * num

    def _times(self, message: Any, raw: RawMessage, num: int) -> list[int]:
        default = raw.publish_time_ns if self.source.time == PUBLISH_TIME else raw.log_time_ns
        return [
            default if (stamp := stamp_ns(value)) is None else stamp
            for value in self._spread(self.fields["time"], message, num)
        ]

    def _covariances(self, message: Any, num: int) -> list[tuple[float, float, float]]:
        if not self.fields["covariance"].paths:
            return [self.sigma] * num
        kinds = self._spread(self.fields["covariance_type"], message, num)
        matrices = self._spread(self.fields["covariance"], message, num)
        return [self._covariance(matrix, kind) for matrix, kind in zip(matrices, kinds, strict=True)]

    def _covariance(self, matrix: Any, kind: Any) -> tuple[float, float, float]:
        """xx, xy, yy; what is unknown, all zero or negative (as ROS states "unknown") takes the source's sigma_m."""
        if matrix is None or kind == 0 or (isinstance(kind, str) and "UNKNOWN" in kind):
            return self.sigma
        if isinstance(matrix, int | float):
            matrix = (matrix, 0.0, 0.0, matrix)
        if len(matrix) not in _PLACES:
            return self.sigma
        xx, xy, yy = (_number(matrix[place]) for place in _PLACES[len(matrix)])
        if xx == yy == 0 or xx < 0 or yy < 0:
            return self.sigma
        if not (math.isfinite(xx) and math.isfinite(xy) and math.isfinite(yy) and xx * yy > xy * xy):
            self.counts["bad_covariance"] += 1
            return self.sigma
        return xx, xy, yy

    def _names(self, message: Any, num: int, kind: str) -> list[str | None]:
        """Constant, from a field, or None; truth and poses need a name, so theirs is at last the topic's (and the place)."""
        constant = self.names[kind]
        if constant is not None:
            return [constant] * num
        names = [_name(value) for value in self._spread(self.fields[kind], message, num)]
        if kind == {"truth": "agent", "poses": "sensor"}.get(self.role):
            topic = self.channel.topic.strip("/") or self.role
            places = [f"{topic}/{place}" for place in range(num)] if self.position[0].paths[0].is_plural else [topic] * num
            return [place if name is None else name for name, place in zip(names, places, strict=True)]
        return names


class _LengthError(Exception):
    """Paths of one source found different numbers of items in a message."""


_PLACES: Mapping[int, tuple[int, int, int]] = {4: (0, 1, 3), 9: (0, 1, 4), 36: (0, 1, 7)}
_METRIC = ("x", "y", "z")
_GEODETIC = ("latitude", "longitude", "altitude")


def read_positions(log: MissionLog, readers: Sequence[ChannelReader], progress: Progress) -> Counter[str]:
    """Feed all messages of the readers' channels to them; the counts of what could not be used."""
    counts: Counter[str] = Counter()
    by_channel: dict[int, list[ChannelReader]] = {}
    for reader in readers:
        by_channel.setdefault(reader.channel.id, []).append(reader)
    decoders: dict[int, Decoder] = {}
    for number, served in list(by_channel.items()):
        try:
            decoders[number] = decoder_for(served[0].channel)
        except UndecodableChannel as error:
            counts["undecodable"] += served[0].channel.message_count or 0
            progress.note(f"extract: {error}")
            del by_channel[number]
    topics = {reader.channel.topic for reader in readers}

    def advance(num_bytes: int) -> None:
        bar.update(num_bytes)

    with progress.bar(log.size_bytes, "extract", unit="B", scale=True) as bar:
        for raw in log.messages(topics=topics, on_bytes=advance):
            served = by_channel.get(raw.channel.id, [])
            if not served:
                continue
            try:
                message = decoders[raw.channel.id](raw.data)
            except UndecodableMessage:
                counts["undecodable"] += 1
                continue
            for reader in served:
                reader.read(message, raw)
    for reader in readers:
        reader.check()
        counts.update(reader.counts)
    return counts


def _number(value: Any) -> float:
    """A float; NaN for what is no number."""
    if value is None:
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _name(value: Any) -> str | None:
    """An identity as text; None for none. UUIDs as bytes or numbers become hexadecimal."""
    if value is None or value == "":
        return None
    if isinstance(value, str | int):
        return str(value)
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    inner = getattr(value, "uuid", value)
    try:
        return bytes(inner).hex()
    except (TypeError, ValueError):
        return str(inner)
