"""Looks of sensors between the stages: looks.parquet, a row a look, and sensors.json, what those of each footprint see.

Both are there only where a log's sensors were stated. `read_looks` makes of them what `cadence.evidence.silence` weighs by.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from cadence.arrays import Float64s, Int64s
from cadence.constraints.obstacles import Obstacles
from cadence.errors import InputError
from cadence.evidence.footprints import Area, DetectionCurve, Polygon, Sector
from cadence.evidence.silence import Looks, Silence
from pipeline.documents import parse_json
from pipeline.look_files import LOOKS_NAME, SENSORS_NAME
from pipeline.tables import Frame, read_table, write_table
from schemas.tables import LOOKS

_VERSION = 1


@dataclass(frozen=True)
class Footprint:
    """What the looks of one entry have in common.

    sensor      its name, perhaps with `*`
    curves      P(detect) as pairs of a distance in metres and a probability; fitted ones two, each from other times than those
                at which it is used (column `part`)
    shape, corners_m, half_angle_rad  of its area
    is_hidden   obstacles hide what is behind them
    is_standing none of its sensors moves
    trust       share of its silence that is believed
    num_looks, num_hits  that a fitted curve rests on; None where it was stated
    """

    sensor: str
    curves: tuple[tuple[tuple[float, float], ...], ...]
    shape: Literal["around", "sector", "polygon", "ground"] = "around"
    corners_m: tuple[tuple[float, float], ...] = ()
    half_angle_rad: float | None = None
    is_hidden: bool = False
    is_standing: bool = False
    trust: float = 1.0
    num_looks: int | None = None
    num_hits: int | None = None

    def curve(self, part: int) -> DetectionCurve:
        """The curve of the looks of a part."""
        pairs = np.array(self.curves[min(part, len(self.curves) - 1)], dtype=np.float64).reshape(-1, 2)
        return DetectionCurve(pairs[:, 0], pairs[:, 1])

    @property
    def area(self) -> Area | None:
        """What limits it beside the curves."""
        if self.shape == "sector":
            assert self.half_angle_rad is not None
            return Sector(self.half_angle_rad)
        if self.shape == "around":
            return None
        return Polygon(np.array(self.corners_m, dtype=np.float64), self.shape == "ground")


def shape_of(area: Area | None) -> dict[str, Any]:
    """The fields of `Footprint` that tell an area."""
    if area is None:
        return {}
    if isinstance(area, Sector):
        return {"shape": "sector", "half_angle_rad": area.half_angle_rad}
    corners = tuple((x, y) for x, y in area.corners_m.tolist())
    return {"shape": "ground" if area.is_on_ground else "polygon", "corners_m": corners}


@dataclass(frozen=True, eq=False)
class LookRows:
    """Looks as columns [L], by time: footprint and part as numbers, who was detected by each (None: nobody knows whom)."""

    time_ns: Int64s
    sensor: Sequence[str]
    footprint: Int64s
    part: Int64s
    position_m: Float64s
    heading_rad: Float64s
    seen: Sequence[frozenset[str | None]]

    def table(self, log_id: str) -> pa.Table:
        """LOOKS."""
        columns = {
            "log_id": pa.array([log_id] * len(self.time_ns)), "time_ns": self.time_ns, "sensor_id": list(self.sensor),
            "footprint": self.footprint, "part": self.part, "x_m": self.position_m[:, 0], "y_m": self.position_m[:, 1],
            "heading_rad": self.heading_rad, "seen": [sorted(names, key=str) for names in self.seen],
        }  # fmt: skip
        return pa.table([pa.array(columns[item.name], type=item.type) for item in LOOKS], schema=LOOKS)


def write_looks(folder: Path, log_id: str, rows: LookRows, footprints: Sequence[Footprint], frame: Frame) -> None:
    """Write both files."""
    write_table(rows.table(log_id), folder / LOOKS_NAME, "looks", frame)
    content = {"version": _VERSION, "footprints": [asdict(footprint) for footprint in footprints]}
    (folder / SENSORS_NAME).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def has_looks(directory: Path) -> bool:
    """Whether a mission directory tells where sensors looked."""
    return (directory / LOOKS_NAME).is_file()


def read_footprints(directory: Path) -> tuple[Footprint, ...]:
    """The footprints of a mission; `InputError` where the file is absent or not ours."""
    path = directory / SENSORS_NAME
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
        if content["version"] != _VERSION:
            raise ValueError(f"version {content['version']}, expected {_VERSION}")
        return tuple(Footprint(**{key: _tuples(value) for key, value in entry.items()}) for entry in content["footprints"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: not a list of footprints ({error}); run extract again with --force") from error


def read_looks(directory: Path, start_ns: int) -> tuple[tuple[Footprint, Looks], ...]:
    """The looks of every footprint and part, in seconds from `start_ns`; empty where the mission has none."""
    if not has_looks(directory):
        return ()
    footprints = read_footprints(directory)
    table, _ = read_table(directory / LOOKS_NAME, "looks")
    time_s = (table["time_ns"].to_numpy() - start_ns) * 1e-9
    number, part = table["footprint"].to_numpy(), table["part"].to_numpy()
    position_m = np.column_stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()])
    heading_rad, seen = table["heading_rad"].to_numpy(), [frozenset(names) for names in table["seen"].to_pylist()]
    found = []
    for index, footprint in enumerate(footprints):
        for which in np.unique(part[number == index]).tolist():
            rows = np.flatnonzero((number == index) & (part == which))
            rows = rows[np.argsort(time_s[rows], kind="stable")]
            looks = Looks(
                time_s[rows], position_m[rows], np.ones(len(rows)), heading_rad[rows], footprint.curve(which), footprint.area,
                tuple(seen[row] for row in rows.tolist()), footprint.trust,
            )  # fmt: skip
            found.append((footprint, looks))
    return tuple(found)


def silences(
    looks: Sequence[tuple[Footprint, Looks]], obstacles: Obstacles, exponent: float
) -> tuple[tuple[Footprint, ...], tuple[Silence, ...]]:
    """The silence of looks by whether obstacles hide from them, and the footprints of all their looks in that order."""
    ordered = sorted(looks, key=lambda each: each[0].is_hidden)
    parts = []
    for is_hidden, hiding in ((False, Obstacles.none()), (True, obstacles)):
        if own := tuple(some for footprint, some in ordered if footprint.is_hidden == is_hidden):
            parts.append(Silence(own, exponent, obstacles=hiding))
    return tuple(footprint for footprint, _ in ordered), tuple(parts)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
