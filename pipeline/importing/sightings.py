"""The rows of a table as positions with all that is known of them, and what was left out, by reason."""

import re
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadence.arrays import Bools, Float64s, Int64s, Objects
from cadence.errors import InputError, UsageError
from pipeline.counted import counted
from pipeline.importing.choice import Choice, Choices, choose
from pipeline.importing.names import FIELDS, METRES, key_of
from pipeline.importing.numbers import read_numbers
from pipeline.importing.places import Naming, Places, degrees, metres
from pipeline.importing.table_file import Columns, TableFile, is_absent, is_text
from pipeline.importing.times import Clock, Times, read_times

_MAX_UNREAD = 0.05
"""Of cells that are not what their column is taken for; with more, it is something else."""
_MIN_NUMBERED = 10
_LOOKED_AT = 1000
_TIME_OF_DAY = re.compile(r"\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d+)?)?(?:\s*[AaPp][Mm])?(?:\s*(?:Z|UTC|GMT|[+-]\d{2}:?\d{2}))?")
_TRUE, _FALSE = ("true", "t", "1", "yes", "y", "truth"), ("false", "f", "0", "no", "n", "", "detection")


@dataclass(frozen=True)
class ImportSettings:
    """How a table is to be read; what is left empty is guessed.

    columns  FIELD=COLUMN, FIELD=COLUMN:UNIT, or FIELD= to leave a field out
    clock    what is told of times
    unit     of the positions
    agent, sensor  who was seen and who saw it in all rows
    sigma_m  standard deviation of positions of which the table states none
    """

    columns: tuple[str, ...] = ()
    clock: Clock = field(default_factory=Clock)
    unit: str = ""
    agent: str = ""
    sensor: str = ""
    sigma_m: float | None = None

    def __post_init__(self) -> None:
        known = ("deg", "rad", "1e-7 deg", "ddmm.mm", *METRES)
        if self.unit and self.unit not in known:
            raise UsageError(f"--unit {self.unit}: not known; give one of {', '.join(known)}")
        if self.sigma_m is not None and not 0 < self.sigma_m < float("inf"):
            raise UsageError(f"--sigma {self.sigma_m}: must be a positive number of metres")


@dataclass(frozen=True, eq=False)
class Sightings:
    """Positions [N] by time, and how they were found.

    first, second  latitude and longitude in degrees where is_geodetic, else x and y in metres
    covariance_m2  [N, 3] xx, xy, yy; NaN where none is stated
    taken     what each field's column was taken as, in words
    examples  a cell of each column
    left_out  rows, by reason
    """

    time_ns: Int64s
    first: Float64s
    second: Float64s
    altitude_m: Float64s
    covariance_m2: Float64s
    agent: Objects
    sensor: Objects
    is_truth: Bools
    is_geodetic: bool
    num_rows: int
    choices: Choices
    taken: dict[str, str]
    examples: dict[str, str]
    left_out: Counter[str]
    notes: tuple[str, ...]


def read_sightings(table: TableFile, settings: ImportSettings) -> Sightings:
    """The positions of a table; `InputError` or `UsageError` where anything about them is in doubt, or nothing is left."""
    choices = choose(table.path, table.names, settings.columns)
    provider = choices.provider
    filters = {name: provider.drop[key] for name in table.names if provider and (key := key_of(name)) in provider.drop}
    columns = table.read(tuple(dict.fromkeys([*(choice.column for choice in choices.columns.values()), *filters])))
    reading = _Reading(table, columns, choices, settings)
    times, places = reading.times(), reading.places()
    left_out: Counter[str] = Counter()
    keep = np.ones(len(times.time_ns), np.bool_)
    others = {
        f"rows whose {name} says that they are no target": np.isin(_words(columns[name]).astype(str), values)
        for name, values in filters.items()
    }
    reasons = {
        "rows without a time": ~times.is_known,
        **others,
        **places.left_out,
        "rows without a position": ~np.isfinite(places.first),
    }
    for reason, is_out in reasons.items():
        left_out[reason] = int((keep & is_out).sum())
        keep &= ~is_out
    agent, numbered = reading.agent()
    is_truth = reading.truth()
    repeated = _repeated(times.time_ns, places, agent, is_truth, keep)
    left_out["rows that repeat another"] = int(repeated.sum())
    rows = np.flatnonzero(keep & ~repeated)
    if not len(rows):
        why = ", ".join(f"{number} {reason}" for reason, number in left_out.items() if number > 0)
        raise InputError(f"{table.path}: no row can be used ({why}); check the columns with --column")
    rows = rows[np.argsort(times.time_ns[rows], kind="stable")]
    taken = reading.taken | {"time": times.words} | dict.fromkeys(reading.pair, places.words)
    notes = (
        *table.bad_rows(),
        *times.notes,
        *numbered,
        *reading.notes,
        *((provider.note,) if provider and provider.note else ()),
    )
    if numbered:
        choices = replace(choices, columns={what: choice for what, choice in choices.columns.items() if what != "agent"})
    return Sightings(
        times.time_ns[rows], places.first[rows], places.second[rows], reading.altitude()[rows], reading.covariance()[rows],
        agent[rows], reading.sensor()[rows], is_truth[rows], places.is_geodetic, len(times.time_ns), choices, taken,
        reading.examples(),
        Counter({reason: number for reason, number in left_out.items() if number > 0}), (*notes, *reading.late_notes),
    )  # fmt: skip


class _Reading:
    """The columns of one table, read one field after the other."""

    def __init__(self, table: TableFile, columns: Columns, choices: Choices, settings: ImportSettings) -> None:
        self._table, self._columns, self._settings = table, columns, settings
        self._choices, self._provider = choices.columns, choices.provider
        self._num_rows = len(next(iter(columns.values())))
        self.pair = ("latitude", "longitude") if choices.is_geodetic else ("x", "y")
        self.taken: dict[str, str] = {}
        self.notes: list[str] = []
        self.late_notes: list[str] = []

    def examples(self) -> dict[str, str]:
        """The first cell of each column that holds something."""
        heads = {name: column.slice(0, _LOOKED_AT).to_pylist() for name, column in self._columns.items()}
        return {name: next((str(cell) for cell in head if cell not in (None, "")), "") for name, head in heads.items()}

    def times(self) -> Times:
        choice, date = self._choices["time"], self._choices.get("date")
        clock = self._settings.clock
        if self._provider is not None and not choice.is_stated:
            clock = replace(clock, zone=clock.zone or self._provider.zone, order=self._provider.order)
        column = self._columns[choice.column]
        if date is not None and not _is_whole(column):
            column = pa.chunked_array([pc.binary_join_element_wise(_text(self._columns[date.column]), _text(column), " ")])
            name = f"{date.column} {choice.column}"
        else:
            if date is not None:
                self._choices = {what: each for what, each in self._choices.items() if what != "date"}
            name = choice.column
        times = read_times(self._table, column, name, clock)
        self._check_read("time", choice, ~times.is_known & ~is_absent(self._columns[choice.column]))
        if times.words.endswith(clock.zone) and self._provider is not None and not self._settings.clock.zone and clock.zone:
            times = replace(times, words=f"{times.words} as its provider says")
        return times

    def places(self) -> Places:
        first, second = (self._choices[name] for name in self.pair)
        values = [self._numbers(name) for name in self.pair]
        for index, name in enumerate(("north_south", "east_west")):
            if name in self._choices and self.pair[0] == "latitude":
                values[index] = values[index] * self._hemisphere(name, "SW"[index], "NE"[index])
        unit = self._settings.unit or first.unit
        is_metric = unit in METRES
        if unit and is_metric == (self.pair[0] == "latitude"):
            raise UsageError(f"--unit {unit}: is no unit of {self.pair[0]}; give --column for x and y, or another unit")
        naming = Naming(first.column, second.column, unit, first.is_stated)
        read = degrees if self.pair[0] == "latitude" else metres
        return read(self._table, values[0], values[1], naming)

    def altitude(self) -> Float64s:
        choice = self._choices.get("altitude")
        if choice is None:
            return np.full(self._num_rows, np.nan)
        agent = self._choices.get("agent")
        if not choice.unit and agent is not None and key_of(agent.column) in _AIRCRAFT:
            self.late_notes.append(
                f"{choice.column} is left out: aircraft's altitudes are feet or metres, and it does not say which; "
                f"give --column 'altitude={choice.column}:ft', or :m"
            )
            self.taken["altitude"] = "left out"
            return np.full(self._num_rows, np.nan)
        self.taken["altitude"] = choice.unit or "m"
        return self._numbers("altitude") * METRES[choice.unit or "m"]

    def covariance(self) -> Float64s:
        names = ("cov_xx", "cov_xy", "cov_yy")
        found = np.full((self._num_rows, 3), np.nan)
        if all(name in self._choices for name in names):
            found = np.column_stack([self._numbers(name) for name in names])
            self.taken |= dict.fromkeys(names, "m²")
            found[~((found[:, 0] > 0) & (found[:, 0] * found[:, 2] > found[:, 1] ** 2))] = np.nan
        elif "sigma" in self._choices:
            found[:, [0, 2]] = self._variance_m2()[:, None]
            found[np.isfinite(found[:, 0]), 1] = 0.0
        sigma_m = self._settings.sigma_m
        if sigma_m is not None:
            found[np.isnan(found).any(axis=1)] = (sigma_m**2, 0.0, sigma_m**2)
        return found

    def _variance_m2(self) -> Float64s:
        choice = self._choices["sigma"]
        values = self._numbers("sigma")
        known = values[np.isfinite(values)]
        if not choice.is_stated and set(np.unique(known).tolist()) <= {0.0, 1.0}:  # AIS says whether it is better than 10 m
            self.late_notes.append(f"{choice.column} is left out: it says yes or no, not how far")
            self.taken["sigma"] = "left out"
            return np.full(self._num_rows, np.nan)
        scale = self._provider.sigma_scale if self._provider is not None and not choice.is_stated else 1.0
        self.taken["sigma"] = f"{choice.unit or 'm'}, as a standard deviation" + (
            f" after a factor of {scale:.3f}" if scale != 1 else ""
        )
        found: Float64s = np.where(values > 0, values * METRES[choice.unit or "m"] * scale, np.nan) ** 2
        return found

    def agent(self) -> tuple[Objects, tuple[str, ...]]:
        """Who was seen in each row; and what is said where a column only numbers rows."""
        choice = self._choices.get("agent")
        if self._settings.agent or choice is None:
            return np.full(self._num_rows, self._settings.agent or None, object), ()
        names = self._names("agent")
        known = [name for name in names.tolist() if name is not None]
        if not choice.is_stated and self._num_rows >= _MIN_NUMBERED and len(known) == len(set(known)) > 1:
            told = f"{choice.column} is left out: it is another in every row, so it numbers rows and names nobody"
            return np.full(self._num_rows, None, object), (told,)
        self.taken["agent"] = counted(len(set(known)), "name")
        return names, ()

    def sensor(self) -> Objects:
        if self._settings.sensor or "sensor" not in self._choices:
            return np.full(self._num_rows, self._settings.sensor or None, object)
        names = self._names("sensor")
        self.taken["sensor"] = counted(len(set(names.tolist()) - {None}), "name")
        return names

    def truth(self) -> Bools:
        choice = self._choices.get("truth")
        if choice is None:
            return np.zeros(self._num_rows, np.bool_)
        column = self._columns[choice.column]
        words = _words(column)
        is_bad = ~np.isin(words.astype(str), (*_TRUE, *_FALSE))
        if is_bad.any():
            row = int(np.flatnonzero(is_bad)[0])
            raise InputError(
                f"{self._table.path}: column {choice.column!r} should say whether a row is the truth, but holds "
                f"{words[row]!r} in {self._table.place(row)}; give true or false, or leave it out: --column truth="
            )
        found: Bools = np.isin(words.astype(str), _TRUE)
        self.taken["truth"] = f"{int(found.sum())} rows are"
        return found

    def _names(self, what: str) -> Objects:
        column = self._columns[self._choices[what].column]
        absent = is_absent(column)
        names = np.array([_name(value) for value in column.to_pylist()], object)
        names[absent] = None
        return names

    def _numbers(self, what: str) -> Float64s:
        choice = self._choices[what]
        values, is_bad = read_numbers(self._columns[choice.column])
        self._check_read(what, choice, is_bad)
        return values

    def _hemisphere(self, what: str, negative: str, positive: str) -> Float64s:
        choice = self._choices[what]
        letters = np.char.upper(_words(self._columns[choice.column]).astype(str))
        is_bad = ~np.isin(letters, (negative, positive, ""))
        self._check_read(what, choice, is_bad)
        self.taken[what] = f"{negative} is negative"
        return np.where(letters == negative, -1.0, np.where(letters == positive, 1.0, np.nan))

    def _check_read(self, what: str, choice: Choice, is_bad: Bools) -> None:
        """Raise where many cells are not what their column is taken for; say it where few are."""
        if not is_bad.any():
            return
        row = int(np.flatnonzero(is_bad)[0])
        cell = self._columns[choice.column][row].as_py()
        seen = f"{int(is_bad.sum())} cells of {choice.column!r} are no {FIELDS[what]}: {cell!r} in {self._table.place(row)}"
        if is_bad.mean() > _MAX_UNREAD:
            raise InputError(f"{self._table.path}: {seen}; name another column with --column {what}=, or correct the table")
        self.notes.append(seen)


_AIRCRAFT = ("icao24", "icao", "icao_address", "hex", "callsign", "call_sign", "registration", "flight")


def _is_whole(column: pa.ChunkedArray) -> bool:
    """Whether a column of times has dates in it: not times of day alone."""
    if not is_text(column):
        return not pa.types.is_time(column.type)
    cells = [cell.strip() for cell in column.slice(0, _LOOKED_AT).to_pylist() if cell and cell.strip()]
    return not cells or not all(_TIME_OF_DAY.fullmatch(cell) for cell in cells)


def _text(column: pa.ChunkedArray) -> pa.ChunkedArray:
    return pc.utf8_trim_whitespace(column) if is_text(column) else column.cast(pa.string())


def _words(column: pa.ChunkedArray) -> Objects:
    """The cells in small letters; empty where there is nothing."""
    return np.array([str(cell).strip().lower() if cell is not None else "" for cell in column.to_pylist()], object)


def _name(value: object) -> str | None:
    """A name as text; a whole number that a table keeps as a float is one without a point."""
    if value is None:
        return None
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() else str(value)
    return str(value).strip()


def _repeated(time_ns: Int64s, places: Places, agent: Objects, is_truth: Bools, keep: Bools) -> Bools:
    """Which rows say of the same target at the same time the same place as a row before."""
    found = np.zeros(len(time_ns), np.bool_)
    seen: set[tuple[object, ...]] = set()
    columns = (time_ns.tolist(), places.first.tolist(), places.second.tolist(), agent.tolist(), is_truth.tolist())
    for row, (is_kept, item) in enumerate(zip(keep.tolist(), zip(*columns, strict=True), strict=True)):
        if is_kept:
            found[row] = item in seen
            seen.add(item)
    return found
