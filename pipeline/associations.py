"""Detections of unknown origin: which agent caused which, and windows of detections under each hypothesis of that.

At a window origin there are many association hypotheses of what was detected so far. The tracks that are to be drawn are shared
out among them by weight; under its association every joint track has detections of known origin and is drawn like any other.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch

from cadence.arrays import Float64s, Int64s
from cadence.association.associate import associate
from cadence.association.fitting import fit_habits, num_steps_to_fit
from cadence.association.particles import Stream
from cadence.association.presence import Habits
from cadence.association.single import is_one_target
from cadence.association.types import CLUTTER, AssociationConfig, AssociationHypotheses, agent_probability, without_unlikely
from cadence.constraints.obstacles import Obstacles
from cadence.errors import InputError
from cadence.resampling import systematic
from cadence.seeds import part_seeds
from cadence.types import Evidence, WindowBatch
from pipeline.grids import Grid, GridConfig, plan_grid
from pipeline.progress import Progress
from pipeline.tracks import DetectionTrack, track_of
from pipeline.windows import MissionWindows, is_first_or_last, kept_tracks, middle_m, padded_detections, window_seeds
from schemas.tables import ASSOCIATIONS, LABELS

_LEAST_PROBABILITY = 1e-3
"""Rows of ASSOCIATIONS that are less likely at both times are left out."""

_ROUGH_PARTICLES = 16


@dataclass(frozen=True, eq=False)
class DataAssociation:
    """What the N detections of unknown origin of a log may have come from, as known at every window origin [B].

    stream     the detections by time; row [N] where each stands in the DETECTIONS table
    origins_ns [B]
    at_origins [B] hypotheses of the detections up to the origin
    agent_ids  names of the agents, by label
    """

    stream: DetectionTrack
    row: Int64s
    origins_ns: Int64s
    at_origins: tuple[AssociationHypotheses, ...]
    agent_ids: tuple[str, ...]

    def named(self, detections: pa.Table) -> pa.Table:
        """The table with the likeliest agents of the last origin as `agent_id`, without what is taken for clutter.

        Raises `InputError` where nothing is left.
        """
        label = self.at_origins[-1].label[0]
        names = np.array(detections["agent_id"].to_pylist(), dtype=object)
        known = self.row[: len(label)]
        names[known] = [self.agent_ids[agent] if agent != CLUTTER else None for agent in label]
        column = detections.schema.get_field_index("agent_id")
        named = detections.set_column(column, detections.schema.field("agent_id"), pa.array(names.tolist(), pa.string()))
        found = named.filter(pa.array([name is not None for name in names]))
        if found.num_rows == 0:
            raise InputError("detections: all of them are taken for clutter; set infer.association.clutter_share = 0")
        return found

    def rows(self, detections: pa.Table) -> pa.Table:
        """ASSOCIATIONS: how likely it is that each agent caused each detection, when it was first known of and in the end."""
        last = agent_probability(self.at_origins[-1])
        known_by = np.array([found.num_detections for found in self.at_origins])
        found: dict[str, list[Any]] = {name: [] for name in ASSOCIATIONS.names}
        first_window = np.searchsorted(known_by, np.arange(len(last)), side="right")
        for window in np.unique(first_window).tolist():
            at = np.flatnonzero(first_window == window)
            then = agent_probability(self.at_origins[window])[at]
            detection, agent = np.nonzero(np.maximum(then, last[at]) >= _LEAST_PROBABILITY)
            rows = detections.take(pa.array(self.row[at[detection]]))
            found["detection"] += self.row[at[detection]].tolist()
            for name in ("log_id", "time_ns", "topic", "log_time_ns", "sequence"):
                found[name] += rows[name].to_pylist()
            found["agent_id"] += [self.agent_ids[a] if a < len(self.agent_ids) else None for a in agent]
            found["first_window"] += [window] * len(at[detection])
            found["first_probability"] += then[detection, agent].tolist()
            found["probability"] += last[at][detection, agent].tolist()
        return pa.Table.from_pydict(found, schema=ASSOCIATIONS)

    def labels(self, grid: Grid) -> pa.Table:
        """LABELS: whose each detection is under the likeliest association of each window."""
        names = pa.array([*self.agent_ids, None], pa.string())  # the label of clutter, -1, is the last
        parts = []
        for window, associations in enumerate(self.at_origins):
            begin = int(self.origins_ns[window]) - grid.context_ns
            known = self.stream.time_ns[: associations.num_detections]
            low = 0 if window == len(self.at_origins) - 1 else int(np.searchsorted(known, begin, "right"))
            label = associations.label[0, low:] % (len(self.agent_ids) + 1)
            columns = [np.full(len(label), window, np.int32), self.row[low : len(known)], names.take(pa.array(label))]
            parts.append(pa.Table.from_arrays([pa.array(column) for column in columns], schema=LABELS))
        return pa.concat_tables(parts)

    @staticmethod
    def of_labels(detections: pa.Table, labels: pa.Table, grid: Grid, default_sigma_m: float = 0.0) -> "DataAssociation":
        """The likeliest association of each window alone, out of LABELS; what a window does not hold is without a label."""
        nameless = _Nameless.of(detections, default_sigma_m)
        agent_ids = tuple(sorted(name for name in labels["agent_id"].unique().to_pylist() if name is not None))
        place = np.full(detections.num_rows, -1)
        place[nameless.row] = np.arange(len(nameless.row))
        window, at = labels["window"].to_numpy(), place[labels["detection"].to_numpy()]
        agent = pc.index_in(labels["agent_id"], value_set=pa.array(agent_ids, pa.string())).fill_null(CLUTTER).to_numpy()
        at_origins = []
        for number, num_known in enumerate(np.searchsorted(nameless.track.time_ns, grid.origins_ns, "right")):
            label = np.full((1, int(num_known)), CLUTTER)
            label[0, at[window == number]] = agent[window == number]
            at_origins.append(AssociationHypotheses(label, np.ones(1), len(agent_ids)))
        return DataAssociation(nameless.track, nameless.row, grid.origins_ns, tuple(at_origins), agent_ids)


@dataclass(frozen=True, eq=False)
class Sources:
    """Where the detections come from: by name, as the settings of a model are fitted to them, and as known at each origin.

    association is None where the origin of every detection is known (or nobody asked for more than one agent)
    """

    named: pa.Table
    grid: Grid
    association: DataAssociation | None


def tell_sources(
    detections: pa.Table,
    grid: GridConfig,
    config: AssociationConfig | None,
    seed: int,
    default_sigma_m: float = 0.0,
    max_speed_mps: float | None = None,
    progress: Progress | None = None,
) -> Sources:
    """Names for detections without one, and the grid, whose step follows from the gaps of single agents.

    With `config` None the nameless are one agent, UNKNOWN_AGENT. Where their number is unknown and one target explains them
    all, they are one's.
    """
    planned = plan_grid(detections, grid)
    if config is None or detections["agent_id"].null_count == 0:
        return Sources(detections, planned, None)
    nameless = _Nameless.of(detections, default_sigma_m)
    if config.num_agents is None and detections["agent_id"].null_count == detections.num_rows:
        config = replace(config, num_agents=1 if is_one_target(nameless.stream, max_speed_mps) else None)
    num = len(nameless.row)
    num_steps = num_steps_to_fit(num, config) + num * (2 if grid.step_s is None else 1)
    with (progress or Progress(quiet=True)).bar(num_steps, "tell apart", unit="detection") as bar:
        habits = fit_habits(nameless.stream, config, seed, max_speed_mps, bar.update)
        if grid.step_s is None:
            # A few particles tell how long gaps are.
            rough = replace(config, num_particles=min(config.num_particles, _ROUGH_PARTICLES), num_associations=1)
            first = nameless.told_apart(planned.origins_ns[-1:], rough, seed, habits, bar.update)
            planned = plan_grid(first.named(detections), grid)
        association = nameless.told_apart(planned.origins_ns, config, seed, habits, bar.update)
    return Sources(association.named(detections), planned, association)


@dataclass(frozen=True, eq=False)
class _Nameless:
    """Detections of unknown origin by time, where they stand in their table [N], and the names that others have."""

    track: DetectionTrack
    row: Int64s
    taken: frozenset[str]

    @staticmethod
    def of(detections: pa.Table, default_sigma_m: float) -> "_Nameless":
        nameless = np.flatnonzero(detections["agent_id"].is_null().to_numpy())
        row = nameless[np.argsort(detections["time_ns"].to_numpy()[nameless], kind="stable")]
        taken = frozenset(name for name in detections["agent_id"].unique().to_pylist() if name is not None)
        return _Nameless(track_of(detections.take(pa.array(row)), default_sigma_m), row, taken)

    @property
    def stream(self) -> Stream:
        """Seconds since the first detection, metres about the middle of all."""
        position_m = self.track.position_m - self.track.position_m.mean(axis=0)
        return Stream(self._seconds(self.track.time_ns), position_m, self.track.covariance_m2)

    def told_apart(
        self, origins_ns: Int64s, config: AssociationConfig, seed: int, habits: Habits, on_step: Callable[[], object]
    ) -> DataAssociation:
        stream = self.stream
        found = associate(
            stream.time_s,
            stream.position_m,
            stream.covariance_m2,
            self._seconds(origins_ns),
            config,
            seed,
            habits=habits,
            on_step=on_step,
        )
        if config.num_agents is None:
            found = without_unlikely(found)
        numbers = (number for number in itertools.count() if f"a{number}" not in self.taken)
        agent_ids = tuple(f"a{number}" for number in itertools.islice(numbers, found[-1].num_agents))
        return DataAssociation(self.track, self.row, origins_ns, tuple(found), agent_ids)

    def _seconds(self, time_ns: Int64s) -> Float64s:
        return np.asarray((time_ns - self.track.time_ns[0]) * 1e-9)


@dataclass(frozen=True, eq=False)
class _Window:
    """One window: the association of each track hypothesis [K], and the detections of every agent under each that is used.

    probability [A] of each agent's being there; entropy_bits [A] of the origin of its detections in the window.
    """

    association: Int64s
    tracks: tuple[dict[int, Int64s], ...]
    probability: Float64s
    entropy_bits: Float64s


@dataclass(frozen=True, eq=False)
class AssociatedWindows:
    """Windows of a mission with several association hypotheses each.

    windows      every agent's detections under the likeliest association in which it has any: what tables say of them
    probability, entropy_bits [B, A]  of each agent's being there, and of the origin of its detections; NaN: origin known
    """

    windows: MissionWindows
    probability: Float64s
    entropy_bits: Float64s
    _each: tuple[_Window, ...]
    _pool: DetectionTrack

    def located(self, start_ns: int, obstacles: Obstacles, evidence: tuple[Evidence, ...] = ()) -> "AssociatedWindows":
        """See `MissionWindows.located`."""
        return replace(self, windows=self.windows.located(start_ns, obstacles, evidence))

    def tracks(self, part: slice) -> tuple[MissionWindows, torch.Tensor]:
        """Some windows [b] whose columns are all different tracks, and the column of each hypothesis and agent [b, K, A].

        Columns are -1 where an agent is not there. An estimator that treats tracks apart draws every one of them once.
        """
        chosen = self._each[part]
        num_agents = len(self.windows.agent_ids)
        index: list[list[Int64s]] = []
        column = np.full((len(chosen), len(chosen[0].association), num_agents), -1)
        for b, window in enumerate(chosen):
            place: dict[tuple[int, bytes], int] = {}
            found: list[Int64s] = []
            for number, tracks in enumerate(window.tracks):
                for agent, rows in tracks.items():
                    key = (agent, rows.tobytes())
                    if key not in place:
                        place[key] = len(found)
                        found.append(rows)
                    column[b, window.association == number, agent] = place[key]
            index.append(found)
        names = tuple(str(number) for number in range(max(1, *(len(found) for found in index))))
        return self._laid_out(index, names, np.arange(len(self._each))[part]), torch.from_numpy(column)

    def by_association(self, part: slice) -> tuple[MissionWindows, Int64s, Int64s]:
        """Every association of some windows as a window [E], whose it is [E], and its number of track hypotheses [E]."""
        numbers = np.arange(len(self._each))[part]
        index, window, count = [], [], []
        for b in numbers:
            for number, tracks in enumerate(self._each[b].tracks):
                index.append([tracks.get(agent, _NONE) for agent in range(len(self.windows.agent_ids))])
                window.append(b)
                count.append(int((self._each[b].association == number).sum()))
        chosen = np.array(window)
        laid_out = self._laid_out(index, self.windows.agent_ids, chosen)
        # windows that differ in their association alone must not share their random numbers; "way" is what it was called first,
        # and part of the seed
        rank = np.arange(len(chosen)) - np.searchsorted(chosen, chosen)
        seeds = part_seeds(laid_out.batch.seeds, "way", torch.from_numpy(rank))
        return replace(laid_out, batch=replace(laid_out.batch, seeds=seeds)), chosen, np.array(count)

    def _laid_out(self, index: list[list[Int64s]], names: tuple[str, ...], window: Int64s) -> MissionWindows:
        whole = self.windows
        datum_m, origins_ns = whole.datum_m[window], whole.origins_ns[window]
        detections = padded_detections(self._pool, _picked(index, len(names)), origins_ns, datum_m)
        pick = torch.from_numpy(window)
        context = None if whole.batch.context is None else whole.batch.context[pick]
        batch = WindowBatch(whole.batch.time_s, detections, whole.batch.seeds[pick], whole.batch.origin_index, context)
        return MissionWindows(batch, origins_ns, whole.step_ns, names, datum_m)


_NONE = np.zeros(0, dtype=np.int64)


def build_associated_windows(
    detections: pa.Table, sources: Sources, seed: int, num_hypotheses: int, default_sigma_m: float = 0.0
) -> AssociatedWindows:
    """The windows of a log with detections of unknown origin, `num_hypotheses` shared out among the associations of each."""
    association, grid = sources.association, sources.grid
    assert association is not None
    named = detections.filter(detections["agent_id"].is_valid())
    known = kept_tracks(named, grid, default_sigma_m)
    agent_ids = tuple(sorted({*known, *association.agent_ids}))
    builder = _Builder(association, grid, known, agent_ids)
    seeds = window_seeds(seed, len(grid.origins_ns))
    each = tuple(builder.window(b, int(seeds[b]), num_hypotheses) for b in range(len(seeds)))
    pick = _picked([[_first(window, agent) for agent in range(len(agent_ids))] for window in each], len(agent_ids))
    datum_m = middle_m(builder.pool, pick)
    found = padded_detections(builder.pool, pick, grid.origins_ns, datum_m)
    batch = WindowBatch(grid.time_s, found, seeds, grid.origin_index)
    windows = MissionWindows(batch, grid.origins_ns, grid.step_ns, agent_ids, datum_m)
    probability, entropy = (np.stack([getattr(window, name) for window in each]) for name in ("probability", "entropy_bits"))
    return AssociatedWindows(windows, probability, entropy, each, builder.pool)


def _first(window: _Window, agent: int) -> Int64s:
    """The agent's detections under the likeliest association that has any."""
    return next((tracks[agent] for tracks in window.tracks if agent in tracks), _NONE)


@dataclass(frozen=True, eq=False)
class _Builder:
    """Builds windows: detections of unknown origin by association, those of known origin alike under all of them."""

    association: DataAssociation
    grid: Grid
    known: dict[str, DetectionTrack]
    agent_ids: tuple[str, ...]

    @cached_property
    def pool(self) -> DetectionTrack:
        """The stream, and after it the detections of the agents that the log names, in the order of `known`."""
        return DetectionTrack.one_behind_the_other([self.association.stream, *self.known.values()])

    @cached_property
    def _column(self) -> Int64s:
        """Column of each label."""
        return np.array([self.agent_ids.index(name) for name in self.association.agent_ids], dtype=np.int64)

    def window(self, b: int, seed: int, num_hypotheses: int) -> _Window:
        """Window `b` under each of its associations."""
        origin_ns = int(self.grid.origins_ns[b])
        start_ns, associations = origin_ns - self.grid.context_ns, self.association.at_origins[b]
        low = int(np.searchsorted(self.association.stream.time_ns[: associations.num_detections], start_ns, "right"))
        label = associations.label[:, low:]
        fixed = self._fixed(start_ns, origin_ns)
        owner = shared_out(associations.weight, num_hypotheses, seed)
        used, association = np.unique(owner, return_inverse=True)
        tracks = tuple(fixed | self._tracks(label[number], low) for number in used)
        probability, entropy = np.full((2, len(self.agent_ids)), np.nan)
        is_there = np.stack([(label == agent).any(axis=1) for agent in range(len(self._column))], axis=-1)  # [M, A]
        probability[self._column] = associations.weight @ is_there
        entropy[self._column] = _entropy_bits(agent_probability(replace(associations, label=label)))
        return _Window(association, tracks, probability, entropy)

    def _tracks(self, label: Int64s, low: int) -> dict[int, Int64s]:
        """By agent: which detections of the stream are its under one association, the first and the last of every step."""
        found = {}
        for agent in np.unique(label[label != CLUTTER]).tolist():
            rows = low + np.flatnonzero(label == agent)
            found[int(self._column[agent])] = rows[is_first_or_last(self.association.stream.time_ns[rows], self.grid)]
        return found

    def _fixed(self, start_ns: int, origin_ns: int) -> dict[int, Int64s]:
        found, begin = {}, len(self.association.stream)
        for name, track in self.known.items():
            first, last = np.searchsorted(track.time_ns, [start_ns, origin_ns], "right")
            if first < last:
                found[self.agent_ids.index(name)] = begin + np.arange(first, last)
            begin += len(track)
        return found


def shared_out(weight: Float64s, num_hypotheses: int, seed: int) -> Int64s:
    """The association of each track hypothesis [K] by systematic resampling of weights [M]: m gets K w_m, within one."""
    return systematic(weight, num_hypotheses, np.random.default_rng(seed).random())


def _entropy_bits(probability: Float64s) -> Float64s:
    """By agent [A], how open the origin of its detections is: the mean entropy of the rows of [N, A + 1], by its share."""
    surprise = -np.log2(np.where(probability > 0, probability, 1.0))
    share = probability[:, :-1]
    total = share.sum(axis=0)
    bits = share.T @ (probability * surprise).sum(axis=1)
    return np.where(total > 0, bits / np.where(total > 0, total, 1.0), np.nan)


def _picked(index: list[list[Int64s]], num_columns: int) -> Int64s:
    """Lists of detections by row and column as one array [R, C, N], -1 for padding."""
    num = max((len(rows) for columns in index for rows in columns), default=1)
    pick = np.full((len(index), num_columns, max(num, 1)), -1)
    for r, columns in enumerate(index):
        for c, rows in enumerate(columns):
            pick[r, c, : len(rows)] = rows
    return pick
