"""Strict configuration: frozen dataclasses read from TOML tables and `--set a.b=value`, through one reader.

An unknown key is an error that names the known ones; a value of the wrong type is an error that names the right one. What was
called otherwise in earlier versions is still read: a field says so in its metadata, see `_by_names_of_today`.
"""

import dataclasses
import math
import reprlib
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from cadence.errors import ConfigError
from pipeline.documents import parse_toml
from pipeline.suggestions import did_you_mean

T = TypeVar("T")

_SMALLEST, _LARGEST = 1e-9, 1e9
"""A nanosecond to 30 years, an atom to beyond the moon: other numbers are typing errors, and overflow further on."""
_LARGEST_SEED = 2**63 - 1

_PLAIN = {float: "a number", int: "a whole number", str: "a text", bool: "true or false", Path: "a path"}

TABLES = ("ingest", "extract", "infer", "retrospect", "export", "report", "evaluate", "simulate", "train")
"""The tables of a configuration file, one a stage. One file may hold all of them; each command reads its own."""


def load_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file; `ConfigError` names file, line and column."""
    try:
        return parse_toml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the configuration ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text, so no configuration; check the path") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}; correct the file") from error


def load_tables(path: Path | None, overrides: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """The tables of the file at `path` (none: no file) with the `a.b=value` of `overrides` put in.

    A top-level key that is not in `TABLES` is a `ConfigError`, so that a misspelt table is never silently without effect.
    """
    tables = merge_overrides(load_toml(path) if path is not None else {}, overrides)
    where = str(path) if path is not None else "--set"
    for name, table in tables.items():
        if name not in TABLES:
            raise ConfigError(f"{where}: unknown table {name!r}{did_you_mean(name, TABLES)}; known tables: {', '.join(TABLES)}")
        if not isinstance(table, Mapping):
            raise ConfigError(f"{where}: {name!r} is a table, not a value; write {name}.KEY = {table!r} with one of its keys")
    return tables


def stage_config(
    cls: type[T], table: str | None, path: Path | None, overrides: Sequence[str] = (), seed: int | None = None
) -> T:
    """The configuration `cls` of one command, from its `table` of the file at `path` and from `overrides`.

    Without `table` the fields of `cls` are tables themselves. `seed` replaces every seed in it.
    """
    tables = load_tables(path, overrides)
    names = {field.name for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    config = (
        read_settings(cls, {name: value for name, value in tables.items() if name in names}, "")
        if table is None
        else read_settings(cls, tables.get(table, {}), table)
    )
    return config if seed is None else with_seed(config, seed)


def with_seed(config: T, seed: int) -> T:
    """A copy of a configuration in which every field called `seed`, at any depth, has the value `seed`."""
    changes: dict[str, Any] = {}
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, field.name)
        if field.name == "seed":
            changes["seed"] = seed
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            changes[field.name] = with_seed(value, seed)
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]


def parse_override(text: str) -> tuple[tuple[str, ...], Any]:
    """`a.b=value` as (("a", "b"), value); the value is TOML, or a bare string where it is not TOML."""
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {text!r}: expected KEY=VALUE, for example --set infer.num_hypotheses=50")
    try:
        parsed = parse_toml(f"value = {value}")["value"]
    except ValueError:
        parsed = value
    if not isinstance(parsed, str | int | float | list | dict):  # a bare date or time of day: no key wants one
        parsed = value
    return tuple(part.strip() for part in key.split(".")), parsed


def merge_overrides(tables: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A copy of `tables` with every `a.b=value` of `overrides` put in its place; later ones win."""
    merged: dict[str, Any] = {key: dict(value) if isinstance(value, Mapping) else value for key, value in tables.items()}
    for text in overrides:
        path, value = parse_override(text)
        node = merged
        for part in path[:-1]:
            child = node.setdefault(part, {})
            if not isinstance(child, Mapping):
                raise ConfigError(f"--set {text!r}: {part!r} is a value, not a table")
            node[part] = child = dict(child)
            node = child
        node[path[-1]] = value
    return merged


def read_settings(cls: type[T], tables: Mapping[str, Any], where: str) -> T:
    """What a person states, as `read_config` reads it; numbers that no setting can mean are refused."""
    _check_numbers(tables, where)
    return read_config(cls, tables, where)


def _check_numbers(value: Any, where: str) -> None:
    if isinstance(value, Mapping | list | tuple):
        for key, item in value.items() if isinstance(value, Mapping) else enumerate(value):
            _check_numbers(item, f"{where}[{key}]" if isinstance(key, int) else f"{where}.{key}".lstrip("."))
    elif isinstance(value, float) and not math.isfinite(value):
        # TOML has both; no key means anything by nan, and only a limit can be infinite: there is then none.
        if math.isnan(value) or not where.rpartition(".")[2].startswith("max_"):
            raise ConfigError(f"{where}: {value:g} is nothing that it can mean; give a number")
    elif isinstance(value, int | float) and value:
        largest = _LARGEST_SEED if where.rpartition(".")[2] == "seed" else _LARGEST
        if not _SMALLEST <= abs(value) <= largest:
            raise ConfigError(f"{where}: {value:g} is beyond what it can mean, {_SMALLEST:g} to {largest:g}; correct it")


def read_config(cls: type[T], tables: Mapping[str, Any], where: str = "config") -> T:
    """An instance of the frozen dataclass `cls` from TOML tables; missing keys take their defaults."""
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(cls)
    tables = _by_names_of_today(fields, tables, where)
    unknown = [key for key in tables if key not in fields]
    if unknown:
        meant = did_you_mean(unknown[0], fields) or _elsewhere(hints, unknown[0])
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}{meant}; known keys: {', '.join(fields)}")
    values = {key: _convert(hints[key], value, f"{where}.{key}".lstrip(".")) for key, value in tables.items()}
    missing = [
        name
        for name, field in fields.items()
        if name not in values and field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ConfigError(f"{where}: key {missing[0]!r} is missing and has no default")
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error


def _by_names_of_today(fields: Mapping[str, Any], tables: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The table with the names that keys and values have today.

    metadata of a field: `older_name` is what the key was called, `older_values` maps what values were called to what they are.
    """
    newer = {field.metadata["older_name"]: name for name, field in fields.items() if "older_name" in field.metadata}
    found: dict[str, Any] = {}
    for key, value in tables.items():
        name = newer.get(key, key)
        if name != key and name in tables:
            raise ConfigError(f"{where}: {key!r} is the older name of {name!r}; give one of the two")
        older_values = fields[name].metadata.get("older_values", {}) if name in fields else {}
        found[name] = older_values.get(value, value) if isinstance(value, str) else value
    return found


def changed_settings(config: object) -> list[str]:
    """Names `a.b` of the settings that differ from those of the configuration's class with nothing configured."""
    return _changed(config_as_dict(config), config_as_dict(type(config)()))


def _changed(config: Mapping[str, Any], default: Mapping[str, Any]) -> list[str]:
    found = []
    for name, value in config.items():
        if isinstance(value, Mapping) and isinstance(default.get(name), Mapping):
            found += [f"{name}.{inner}" for inner in _changed(value, default[name])]
        elif value != default.get(name):
            found.append(name)
    return found


def _elsewhere(hints: Mapping[str, Any], key: str) -> str:
    """Which of the tables inside has a key of this name; empty where none has."""
    tables = [name for name, hint in hints.items() if dataclasses.is_dataclass(hint)]
    found = [f"{name}.{key}" for name in tables if key in {field.name for field in dataclasses.fields(hints[name])}]
    return f" (did you mean {found[0]!r}?)" if found else ""


def config_as_dict(config: object) -> dict[str, Any]:
    """The resolved configuration as plain JSON-able values, for manifests."""
    return typing.cast(dict[str, Any], _plain(dataclasses.asdict(config)))  # type: ignore[call-overload]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        return _convert_union(arguments, value, where)
    if origin is typing.Literal:
        if value in arguments:
            return value
        known = list(map(str, arguments))
        raise ConfigError(f"{where}: {_brief(value)} is not one of {', '.join(known)}{did_you_mean(str(value), known)}")
    if dataclasses.is_dataclass(hint):
        if isinstance(value, Mapping):
            return read_config(typing.cast(type[Any], hint), value, where)
        raise ConfigError(f"{where}: expected a table, got {_brief(value)}")
    if origin is tuple and isinstance(value, list | tuple):
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_convert(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(value))
        if len(arguments) == len(value):
            return tuple(
                _convert(kind, item, f"{where}[{i}]") for i, (kind, item) in enumerate(zip(arguments, value, strict=True))
            )
    if origin is dict and isinstance(value, Mapping):
        return {str(key): _convert(arguments[1], item, f"{where}.{key}") for key, item in value.items()}
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    is_number = not (isinstance(value, float) and math.isnan(value))  # TOML has nan; no key means anything by it
    if isinstance(hint, type) and isinstance(value, hint) and (hint is bool or not isinstance(value, bool)) and is_number:
        return value
    raise ConfigError(f"{where}: expected {_describe(hint)}, got {_brief(value)}")


def _convert_union(arguments: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in arguments:
        return None
    errors = []
    for argument in arguments:
        if argument is not type(None):
            try:
                return _convert(argument, value, where)
            except ConfigError as error:
                errors.append(error)
    raise errors[0] if len(errors) == 1 else ConfigError(f"{where}: got {_brief(value)}, which fits none of the allowed types")


def _brief(value: Any) -> str:
    """The value as in a message of one line: long ones are cut."""
    return reprlib.repr(value)


def _describe(hint: Any) -> str:
    if hint in _PLAIN:
        return _PLAIN[hint]
    return getattr(hint, "__name__", str(hint)) if typing.get_origin(hint) is None else str(hint)
