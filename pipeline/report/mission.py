"""A mission directory as arrays: what every part of the page draws from.

Letters of the shapes: K hypothesis, A agent, T time step, N point. Positions are float64 metres in the mission frame
unless a name says otherwise.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cadence.arrays import Float32s, Float64s, Int64s
from cadence.constraints.obstacles import Obstacles
from cadence.errors import InputError
from cadence.evidence.silence import Looks
from pipeline.ask.events import Event
from pipeline.ask.told import read_told
from pipeline.catalogue import Catalogue, read_catalogue, stated_path
from pipeline.documents import parse_json
from pipeline.files import hash_file
from pipeline.looks import Footprint, read_looks
from pipeline.manifest import read_manifest
from pipeline.obstacle_file import OBSTACLES_NAME, as_obstacles, read_obstacle_entries
from pipeline.presence import with_presence
from pipeline.report.inputs import STAGES
from pipeline.report.origins import Origins, origins_of, with_likeliest
from pipeline.results import AgentHypotheses, MissionHypotheses, WindowHypotheses, read_hypothesis_tables
from pipeline.stories import MISSION_NAME, MissionStories, read_stories
from pipeline.tables import Frame, read_table
from pipeline.tracks import UNKNOWN_AGENT

JsonDict = dict[str, Any]

LIKELY = 0.5
"""An agent that is less likely there than this is rather none, as for `cadence evaluate`."""

MAX_STORIES = 30
"""Mission hypotheses that are drawn: the first, as they are in no order."""


@dataclass(frozen=True, eq=False)
class Points:
    """Timed positions with an owner: detections and truth of agents, poses of sensors; sorted by time.

    time_ns [N], owner [N] index into the names that belong to it (-1: unknown), position_m [N, 2]
    height_m [N]  of detections, NaN where unknown; None where heights are not used
    """

    time_ns: Int64s
    owner: Int64s
    position_m: Float64s
    height_m: Float64s | None = None

    def of(self, owner: int) -> "Points":
        """The points of one owner."""
        chosen = self.owner == owner
        height_m = None if self.height_m is None else self.height_m[chosen]
        return Points(self.time_ns[chosen], self.owner[chosen], self.position_m[chosen], height_m)

    def between(self, start_ns: int, end_ns: int) -> "Points":
        """The points with start_ns <= time_ns <= end_ns."""
        first, last = np.searchsorted(self.time_ns, [start_ns, end_ns + 1])
        chosen = slice(int(first), int(last))
        return Points(self.time_ns[chosen], self.owner[chosen], self.position_m[chosen])

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True, eq=False)
class Fan:
    """All hypotheses of one agent in one window.

    weight [K] sums to one; offset_m [K, T, 2] float32 relative to datum_m [2]; step i lies at
    origin_ns + (i - origin_index) * step_ns
    """

    window: int
    agent: int
    origin_ns: int
    step_ns: int
    origin_index: int
    weight: Float64s
    datum_m: Float64s
    offset_m: Float32s

    @property
    def time_ns(self) -> Int64s:
        """Times of the steps [T]."""
        steps = np.arange(self.offset_m.shape[1], dtype=np.int64) - self.origin_index
        return self.origin_ns + steps * self.step_ns


@dataclass(frozen=True, eq=False)
class WindowRow:
    """What is known of one agent in one window, also where nothing could be drawn."""

    window: int
    agent: int
    origin_ns: int
    status: str
    advice: str
    num_detections: int
    age_s: float | None
    spread_m: float | None
    probability: float | None = None
    num_effective: float | None = None


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Rings [N, 2] of a polygon (outline first, then holes); a circle has no rings but a radius."""

    name: str
    rings_m: tuple[Float64s, ...]
    centre_m: tuple[float, float] | None = None
    radius_m: float = 0.0


@dataclass(frozen=True, eq=False)
class Mission:
    """Everything that the page tells of one mission.

    log                       its path; relative to the mission directory where it lies in it
    start_ns, end_ns          of what is drawn: detections, truth, window origins
    log_start_ns, log_end_ns  of the log, where it keeps the same clock
    origins                   who was found among detections of unknown origin; these are given to their likeliest agent
    answers, events           what export answered to configured questions, and events
    stored, solid             hypotheses and obstacles as other stages see them
    looks                     of sensors whose footprints are stated, in seconds from start_ns
    stories                   the first mission hypotheses; None in results without any
    """

    log: str
    catalogue: Catalogue
    frame: Frame
    agents: tuple[str, ...]
    sensors: tuple[str, ...]
    detections: Points
    truth: Points | None
    poses: Points | None
    rows: tuple[WindowRow, ...]
    fans: tuple[Fan, ...]
    obstacles: tuple[Obstacle, ...]
    manifests: dict[str, JsonDict]
    scores: JsonDict | None
    has_stale_scores: bool
    start_ns: int
    end_ns: int
    log_start_ns: int
    log_end_ns: int
    stored: MissionHypotheses
    solid: Obstacles | None = None
    origins: Origins | None = None
    answers: tuple[JsonDict, ...] = ()
    events: tuple[Event, ...] = ()
    looks: tuple[tuple[Footprint, Looks], ...] = ()
    stories: MissionStories | None = None

    def called(self, agent: int, rows: Iterable[WindowRow]) -> str:
        """The agent's name with how likely it is there: the largest probability among `rows`, which are its own."""
        found = [row.probability for row in rows if row.probability is not None]
        return with_presence(self.agents[agent], max(found, default=None))

    def presence(self, agent: int) -> float | None:
        """How likely an agent is there, in the window where it is likeliest; None where the log says who was seen."""
        return self._presences.get(agent)

    @cached_property
    def _presences(self) -> dict[int, float]:
        found: dict[int, float] = {}
        for row in self.rows:
            if row.probability is not None:
                found[row.agent] = max(row.probability, found.get(row.agent, row.probability))
        return found

    @property
    def suspicions(self) -> list[JsonDict]:
        """What stages found that can hardly be meant."""
        summaries = (self.manifests.get(stage, {}).get("summary") or {} for stage in ("extract", "infer"))
        return [record for summary in summaries for record in summary.get("suspicions") or []]

    @property
    def has_presence(self) -> bool:
        """Whether agents may be none: the log does not say who was seen."""
        return any(row.probability is not None for row in self.rows)

    @property
    def name(self) -> str:
        """What the log's file is called."""
        return self.catalogue.path.name

    @property
    def num_tracked(self) -> int:
        """Agents that have hypotheses; the others are only in the truth, or of them nothing can be said."""
        return len({fan.agent for fan in self.fans})

    @property
    def told_agents(self) -> tuple[int, ...]:
        """Agents that the map lists: those with hypotheses; where nobody has any, those that were looked for."""
        return tuple(sorted({fan.agent for fan in self.fans} or {row.agent for row in self.rows}))

    @property
    def drawn_windows(self) -> list[int]:
        """Windows with hypotheses of at least one agent, in the order of time; all where none has any."""
        drawn = {fan.window for fan in self.fans}
        return [window for window in self.origins_ns if window in drawn or not drawn]

    @property
    def origins_ns(self) -> dict[int, int]:
        """Origin by window, in the order of time."""
        return dict(sorted({row.window: row.origin_ns for row in self.rows}.items(), key=lambda item: (item[1], item[0])))


def load_mission(directory: Path) -> Mission:
    """The mission in `directory`; `InputError` where a file that the page cannot do without is absent or damaged."""
    catalogue = read_catalogue(directory)
    detections, frame = read_table(directory / "detections.parquet", "detections")
    hypotheses = read_hypothesis_tables(directory)
    associations = _optional_table(directory, "associations")
    origins = None if associations is None else origins_of(detections, associations)
    detections = detections if associations is None else with_likeliest(detections, associations)
    truth = _optional_table(directory, "truth")
    poses = _optional_table(directory, "poses")
    tables = [table for table in (detections, truth) if table is not None]
    agents = _names(*(table["agent_id"].unique().to_pylist() for table in tables), hypotheses.agent_ids)
    sensors = _names(poses["sensor_id"].unique().to_pylist()) if poses is not None else ()
    rows = _window_rows(hypotheses, agents)
    scores = directory / "scores.json"
    manifests = {stage: found for stage in STAGES if (found := read_manifest(stage, directory)) is not None}
    detection_points = _points(detections, "agent_id", agents, UNKNOWN_AGENT if UNKNOWN_AGENT in hypotheses.agent_ids else None)
    truth_points = _points(truth, "agent_id", agents) if truth is not None else None
    start_ns, end_ns = _time_range(catalogue, [points for points in (detection_points, truth_points) if points], rows)
    log_start_ns, log_end_ns = _log_range(catalogue, start_ns, end_ns)
    answers, events = read_told(directory)
    return Mission(
        log=stated_path(catalogue.path, directory),
        catalogue=catalogue,
        frame=frame,
        agents=agents,
        sensors=sensors,
        detections=detection_points,
        truth=truth_points,
        poses=_points(poses, "sensor_id", sensors) if poses is not None else None,
        rows=rows,
        fans=_fans(hypotheses, agents),
        obstacles=tuple(_obstacle(entry) for entry in _obstacle_entries(directory)),
        manifests=manifests,
        scores=_read_json(scores) if scores.is_file() else None,
        has_stale_scores=_is_stale(manifests.get("evaluate"), directory / "hypotheses.parquet"),
        start_ns=start_ns,
        end_ns=end_ns,
        log_start_ns=log_start_ns,
        log_end_ns=log_end_ns,
        stored=hypotheses,
        solid=as_obstacles(entries) if (entries := _obstacle_entries(directory)) else None,
        origins=origins,
        answers=tuple(answers),
        events=tuple(events),
        looks=read_looks(directory, start_ns),
        stories=read_stories(directory, MAX_STORIES) if (directory / MISSION_NAME).is_file() else None,
    )


def _is_stale(manifest: JsonDict | None, path: Path) -> bool:
    """Whether the manifest names another content for the input at `path`."""
    digest = (manifest or {}).get("inputs", {}).get(path.name)
    return digest is not None and digest != hash_file(path)


def _read_json(path: Path) -> JsonDict:
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found; run the stage that writes it first (cadence run does all of them)") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not readable JSON ({error}); run its stage again with --force") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object; run its stage again with --force")
    return content


def _optional_table(directory: Path, name: str) -> pa.Table | None:
    path = directory / f"{name}.parquet"
    return read_table(path, name)[0] if path.is_file() else None


def _names(*columns: Iterable[str | None]) -> tuple[str, ...]:
    """Every name once, numbers inside names in the order of numbers (T2 before T10)."""
    found = {name for column in columns for name in column if name is not None}
    return tuple(sorted(found, key=_natural))


def _natural(name: str) -> tuple[list[str | int], str]:
    # Splitting at captured digits alternates text and number, so that keys always compare like with like.
    parts = re.split(r"([0-9]{1,15})", name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], name


def _index(column: pa.ChunkedArray, names: tuple[str, ...]) -> Int64s:
    order = {name: index for index, name in enumerate(names)}
    encoded = column.combine_chunks().dictionary_encode()
    lookup: Int64s = np.array([*(order[name] for name in encoded.dictionary.to_pylist()), -1], dtype=np.int64)
    return np.asarray(lookup[encoded.indices.fill_null(len(lookup) - 1).to_numpy(zero_copy_only=False)])


def _points(table: pa.Table, column: str, names: tuple[str, ...], stand_in: str | None = None) -> Points:
    """Finite positions by time; owners that are null become `stand_in`."""
    position_m = np.column_stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()]).astype(np.float64).reshape(-1, 2)
    time_ns = table["time_ns"].to_numpy().astype(np.int64)
    owner = _index(table[column] if stand_in is None else table[column].fill_null(stand_in), names)
    usable = np.isfinite(position_m).all(axis=1)
    order = np.argsort(time_ns[usable], kind="stable")
    height_m = table["z_m"].to_numpy().astype(np.float64)[usable][order] if "cov_zz_m2" in table.column_names else None
    return Points(time_ns[usable][order], owner[usable][order], position_m[usable][order], height_m)


def _window_rows(found: MissionHypotheses, agents: tuple[str, ...]) -> tuple[WindowRow, ...]:
    place = {name: index for index, name in enumerate(agents)}
    return tuple(
        WindowRow(
            window.window, place[agent.agent_id], window.origin_ns, agent.status, agent.advice or "", agent.num_detections,
            agent.age_s, agent.spread_m, agent.probability, agent.num_effective,
        )
        for window in found.windows
        for agent in sorted(window.agents, key=lambda agent: place[agent.agent_id])
    )  # fmt: skip


def _fans(found: MissionHypotheses, agents: tuple[str, ...]) -> tuple[Fan, ...]:
    place = {name: index for index, name in enumerate(agents)}
    fans = (
        _fan(window, agent, place[agent.agent_id])
        for window in found.windows
        for agent in sorted(window.agents, key=lambda agent: place[agent.agent_id])
        if agent.is_live
    )
    return tuple(fan for fan in fans if fan is not None)


def _fan(window: WindowHypotheses, agent: AgentHypotheses, index: int) -> Fan | None:
    # Hypotheses with a hole in them cannot be drawn.
    usable = np.isfinite(agent.position_m).all(axis=(1, 2))
    weight = window.weight[usable].astype(np.float64)
    if len(weight) == 0:
        return None
    share = weight / weight.sum() if weight.sum() > 0 else np.full(len(weight), 1 / len(weight))
    # A view where all are usable: copies of everything would double the memory of a large mission.
    offset_m = agent.position_m if usable.all() else agent.position_m[usable]
    return Fan(
        window.window, index, window.origin_ns, window.step_ns, window.origin_index, share, np.array(agent.datum_m), offset_m
    )


def _obstacle_entries(directory: Path) -> list[JsonDict]:
    path = directory / OBSTACLES_NAME
    return read_obstacle_entries(path) if path.is_file() else []


def _obstacle(entry: JsonDict) -> Obstacle:
    name = str(entry.get("name") or "")
    if entry["kind"] == "circle":
        return Obstacle(name, (), (float(entry["x_m"]), float(entry["y_m"])), float(entry["radius_m"]))
    return Obstacle(name, tuple(np.asarray(ring, dtype=np.float64).reshape(-1, 2) for ring in entry["rings_m"]))


def _time_range(catalogue: Catalogue, points: list[Points], rows: tuple[WindowRow, ...]) -> tuple[int, int]:
    times = [int(time) for found in points if len(found) for time in (found.time_ns[0], found.time_ns[-1])]
    times += [rows[0].origin_ns, rows[-1].origin_ns] if rows else []
    return (min(times), max(times)) if times else (catalogue.start_ns, catalogue.end_ns)


def _log_range(catalogue: Catalogue, start_ns: int, end_ns: int) -> tuple[int, int]:
    """The log's own range; start and end where its clock is another one than that of the detections' stamps."""
    is_same_clock = catalogue.start_ns <= end_ns and start_ns <= catalogue.end_ns
    return (catalogue.start_ns, catalogue.end_ns) if is_same_clock else (start_ns, end_ns)
