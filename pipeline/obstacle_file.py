"""obstacles.json: the obstacles of a mission, in its frame, as extract leaves them and every later stage reads them.

It holds {"version": 1, "obstacles": [...]}; an obstacle is {"kind": "circle", "x_m", "y_m", "radius_m"} or
{"kind": "polygon", "rings_m": [exterior, holes...]}, each with an optional "name".
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadence.errors import InputError
from pipeline.documents import parse_json

if TYPE_CHECKING:
    from cadence.constraints.obstacles import Obstacles
    from cadence.worlds.terrain import Terrain

VERSION = 1
OBSTACLES_NAME = "obstacles.json"

Json = dict[str, Any]


def write_obstacles(path: Path, obstacles: Sequence[Mapping[str, Any]]) -> None:
    """Write obstacles.json."""
    path.write_text(json.dumps({"version": VERSION, "obstacles": list(obstacles)}, indent=1) + "\n", encoding="utf-8")


def read_obstacles(path: Path) -> "Obstacles":
    """The obstacles of a mission as the estimators see them; `InputError` where the file is absent or not ours."""
    return as_obstacles(read_obstacle_entries(path))


def read_obstacle_entries(path: Path) -> list[Json]:
    """The entries of an obstacles.json, each with its meaning checked; `InputError` where the file is absent or not ours."""
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
        return [checked_entry(entry) for entry in listed_entries(content)]
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); run extract first (cadence run does all stages)"
        ) from error
    except (ValueError, TypeError, LookupError) as error:
        raise InputError(f"{path}: not a list of obstacles ({error}); run extract again with --force") from error


def as_obstacles(entries: Sequence[Mapping[str, Any]]) -> "Obstacles":
    """Entries of obstacles.json as the estimators see them. ValueError where one has no meaning."""
    import torch  # only now: what a mission has to say of obstacles is asked more often than what estimators see

    from cadence.constraints.obstacles import Obstacles

    circles = [[entry["x_m"], entry["y_m"], entry["radius_m"]] for entry in entries if entry["kind"] == "circle"]
    polygons = [entry["rings_m"] for entry in entries if entry["kind"] == "polygon"]
    rings = tuple(tuple(torch.tensor(ring, dtype=torch.float64).reshape(-1, 2) for ring in polygon) for polygon in polygons)
    return Obstacles(torch.tensor(circles, dtype=torch.float64).reshape(-1, 3), rings)


def obstacles_as_json(terrain: "Terrain") -> list[dict[str, Any]]:
    """Obstacles in the format of obstacles.json: circles and polygons in the mission frame, rounded to a millimetre."""
    circles = [{"kind": "circle", "x_m": x, "y_m": y, "radius_m": r} for x, y, r in np.round(terrain.circles_m, 3).tolist()]
    rings = [np.round(polygon, 3).tolist() for polygon in terrain.polygons_m]
    return [*({"kind": "polygon", "rings_m": [[*ring, ring[0]]]} for ring in rings), *circles]


def listed_entries(content: Any) -> list[Any]:
    """The list in the content of an obstacles.json; ValueError where it is not one of this version."""
    if not isinstance(content, dict) or not isinstance(content.get("obstacles"), list):
        raise ValueError("no list `obstacles`")
    if content.get("version") != VERSION:
        raise ValueError(f"version {content.get('version')!r}, expected {VERSION}")
    entries: list[Any] = content["obstacles"]
    return entries


def checked_entry(entry: Any) -> Json:
    """The entry with plain floats; ValueError, TypeError or LookupError where it has no meaning."""
    kind = entry["kind"]
    name = {"name": str(entry["name"])} if entry.get("name") else {}
    if kind == "circle":
        clean: Json = {"kind": kind, **{key: float(entry[key]) for key in ("x_m", "y_m", "radius_m")}, **name}
    elif kind == "polygon":
        clean = {"kind": kind, "rings_m": [[[float(x), float(y)] for x, y in ring] for ring in entry["rings_m"]], **name}
    else:
        raise ValueError(f"kind {kind!r}, expected circle or polygon")
    as_obstacles([clean])
    return clean
