"""Which column holds what: as the user says, as the provider of the table does, and by names."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cadence.errors import InputError, UsageError
from pipeline.importing.names import FIELDS, guess, key_of, unit_of, units_of
from pipeline.importing.providers import Provider, provider_of
from pipeline.suggestions import did_you_mean


@dataclass(frozen=True)
class Choice:
    """A column for a field.

    unit  as stated by the user, the provider or the name; empty: by none of them
    by    who says so
    """

    column: str
    unit: str
    by: str

    @property
    def is_stated(self) -> bool:
        """Whether the user named it."""
        return self.by == "you"


@dataclass(frozen=True)
class Choices:
    """The column of each field that has one, and the kind of table, where it is known."""

    columns: Mapping[str, Choice]
    provider: Provider | None = None
    notes: tuple[str, ...] = field(default=())

    @property
    def is_geodetic(self) -> bool:
        """Whether positions are latitudes and longitudes."""
        return "latitude" in self.columns


def choose(path: Path, names: Sequence[str], stated: Sequence[str]) -> Choices:
    """The columns to be read.

    `stated` are the user's `FIELD=COLUMN`, `FIELD=COLUMN:UNIT` or, to leave a field out, `FIELD=`. Raises `UsageError` where
    one of these is wrong, `InputError` where a needed field has no column, or several that are equally likely.
    """
    own = dict(_stated(path, text, names) for text in stated)
    provider = provider_of(names)
    found: dict[str, Choice] = {what: choice for what, choice in own.items() if choice is not None}
    for what in FIELDS:
        if what not in own and (choice := _guessed(path, what, names, provider, found)) is not None:
            found[what] = choice
    _check_positions(path, found, own, names)
    if "date" in found and not found["date"].is_stated and provider is not None:
        del found["date"]
    if "time" not in found and "date" in found:
        found["time"] = found.pop("date")
    if "time" not in found:
        raise InputError(f"{path}: no column looks like a time; give --column time=NAME; columns: {_listed(names)}")
    return Choices(found, provider)


def _stated(path: Path, text: str, names: Sequence[str]) -> tuple[str, Choice | None]:
    what, sign, column = text.partition("=")
    if not sign or what not in FIELDS:
        advice = did_you_mean(what, FIELDS) or f"; fields: {', '.join(FIELDS)}"
        raise UsageError(f"--column {text}: give FIELD=COLUMN, such as time=UTC; {what!r} is no field{advice}")
    if not column:
        return what, None
    unit = ""
    if column not in names and ":" in column:
        column, _, unit = column.rpartition(":")
        if unit not in units_of(what):
            known = ", ".join(units_of(what)) or "none"
            raise UsageError(f"--column {text}: {unit!r} is no unit of {what}; units: {known}")
    if column not in names:
        raise UsageError(
            f"--column {text}: {path.name} has no column {column!r}{did_you_mean(column, names)}; columns: {_listed(names)}"
        )
    return what, Choice(column, unit or unit_of(column, what), "you")


def _guessed(
    path: Path, what: str, names: Sequence[str], provider: Provider | None, taken: Mapping[str, Choice]
) -> Choice | None:
    if provider is not None and what in provider.columns:
        keys = {key_of(name): name for name in reversed(names)}
        column = next((keys[key] for key in provider.columns[what] if key in keys), None)
        if column is not None:
            return Choice(column, unit_of(column, what) or provider.units.get(what, ""), provider.name)
    used = {choice.column for choice in taken.values()}
    likely = guess(what, [name for name in names if name not in used])
    if likely is None:
        return None
    if not likely.is_sure:
        if what in ("x", "y") and "latitude" in taken:
            return None
        shown = " or ".join(repr(name) for name in likely.names)
        raise InputError(f"{path}: {FIELDS[what]} may be column {shown}; give --column {what}={likely.names[0]}, or the other")
    return Choice(likely.names[0], unit_of(likely.names[0], what), "its name")


def _check_positions(path: Path, found: dict[str, Choice], own: Mapping[str, Choice | None], names: Sequence[str]) -> None:
    """One pair of coordinates: what the user named, else latitude and longitude."""
    if any(own.get(name) is not None for name in ("x", "y")):
        for name in ("latitude", "longitude"):
            if own.get(name) is not None:
                raise UsageError(f"--column {name}: give x and y, or latitude and longitude, not both")
            found.pop(name, None)
    for pair, others in ((("latitude", "longitude"), ("x", "y")), (("x", "y"), ())):
        given = [name for name in pair if name in found]
        if len(given) == 2:
            for name in others:
                found.pop(name, None)
            return
        if given and not (others and all(name in found for name in others)):
            other = pair[1 - pair.index(given[0])]
            raise InputError(
                f"{path}: column {found[given[0]].column!r} looks like {given[0]}, but none like {other}; give "
                f"--column {other}=NAME; columns: {_listed(names)}"
            )
        for name in given:
            del found[name]
    raise InputError(
        f"{path}: no columns look like a position; give --column latitude=NAME --column longitude=NAME, or x and y; "
        f"columns: {_listed(names)}"
    )


def _listed(names: Sequence[str]) -> str:
    rest = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return ", ".join(names[:12]) + rest
