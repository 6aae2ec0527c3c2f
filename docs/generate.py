"""Write docs/cli.md and docs/configuration.md from the code, so that they cannot tell anything else. Run by `make docs`.

Commands come from their own help; configuration keys, types and defaults from the dataclasses, meanings from their docstrings
(lines `name, name  meaning`, continued by indented lines).
"""

import dataclasses
import importlib
import inspect
import re
import sys
import types
import typing
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import typer.testing

import cli
from pipeline.config import TABLES
from pipeline.mapping.message_types import MESSAGE_TYPES

COMMANDS = (
    "info", "doctor", "import", "run", "ingest", "extract", "infer", "retrospect", "export", "report", "evaluate",
    "view", "simulate", "train", "ask",
)  # fmt: skip
QUESTIONS = ("where", "inside", "arrive", "passed", "meet", "same", "searched")

CLI_INTRODUCTION = """# Command line

Made from the commands' own help by `make docs`.

Results go to stdout (as text, or with `--json` as JSON), progress and errors to stderr. Exit codes: 0 ok, 1 defect (with a
traceback), 2 wrong call, 3 unusable input, 4 configuration, mapping or checkpoint that does not fit, 5 device or storage,
7 damaged input (`cadence doctor`), 8 suspected input (something in a log can hardly be meant as it
stands: formats.md), 130 interrupted (Ctrl-C, SIGTERM). `cadence run` on several logs goes on after a bad one and leaves with
the highest code of the failures; without a failure with 8 where results rest on a suspicion, with 7 where a log is damaged,
and with 3 where nothing was detected in any log. Suspicion counts more than damage: a gap is seen as a gap, while a wrong
place is believed.
"""

CONFIGURATION_INTRODUCTION = """# Configuration

Made from the code by `make docs`: key, default and meaning of every setting.

A configuration file is TOML with one table a stage; every key is optional. A single call can differ with `--set`, for which
the same names hold: `--set infer.num_hypotheses=50`. An unknown key or a value of the wrong type is an error (exit code 4) that
names the known keys. What was used in the end is in each stage's manifest.

```toml
[extract.thinning]       # make sparse detections out of a dense truth channel
enabled = true
mean_gap_s = 8.0

[infer]
num_hypotheses = 50
```
"""


MESSAGE_TYPES_INTRODUCTION = """Message types whose fields are known. A source without paths takes that of its channel's schema.
"""


def cli_page() -> str:
    """docs/cli.md: the help of the program and of every command."""
    parts = [CLI_INTRODUCTION, "## cadence\n", _help([])]
    for command in COMMANDS:
        parts += [f"## cadence {command}\n", _help([command])]
    for question in QUESTIONS:
        parts += [f"### cadence ask MISSION {question}\n", _help(["ask", "MISSION", question])]
    return "\n".join(parts)


def configuration_page() -> str:
    """docs/configuration.md: a table of keys for every stage and for every table inside it."""
    parts = [CONFIGURATION_INTRODUCTION]
    described = {stage_config_class(table): f"[{table}]" for table in TABLES}
    for table in TABLES:
        cls = stage_config_class(table)
        parts.append(f"## [{table}]\n")
        parts += _tables_of(cls, table, described)
    parts += ["## Message types\n", MESSAGE_TYPES_INTRODUCTION, "| `message_type` | schemas (in any spelling) |", "|---|---|"]
    for name, known in sorted(MESSAGE_TYPES.items()):
        parts.append(f"| `{name}` | {', '.join(f'`{schema}`' for schema in known.schemas)} |")
    return "\n".join(parts) + "\n"


def stage_config_class(table: str) -> type[Any]:
    """The configuration dataclass behind a table of the file."""
    return typing.cast(type[Any], getattr(importlib.import_module(f"pipeline.{table}.stage"), f"{table.capitalize()}Config"))


def meanings(cls: type[Any]) -> dict[str, str]:
    """What the docstring of a dataclass says of its fields."""
    names = {field.name for field in dataclasses.fields(cls)}
    found: dict[str, str] = {}
    current: list[str] = []
    for line in (inspect.getdoc(cls) or "").splitlines()[1:]:
        match = re.match(r"([a-z][a-z0-9_]*(?:, [a-z][a-z0-9_]*)*)(?: {1,}|:\s+)(\S.*)$", line)
        if match and set(match[1].split(", ")) <= names:
            current = match[1].split(", ")
            text = match[2]
        elif line.startswith("  ") and current:
            text = line.strip()
        else:
            current, text = [], ""
        for name in current:
            found[name] = f"{found.get(name, '')} {text}".strip()
    return found


def fields_of(cls: type[Any]) -> list[tuple[str, str, str, str]]:
    """Name, type, default and meaning of every field that is not a table itself."""
    hints, texts = typing.get_type_hints(cls), meanings(cls)
    return [
        (field.name, _type(hints[field.name]), _default(field), texts.get(field.name, ""))
        for field in dataclasses.fields(cls)
        if _nested(hints[field.name]) is None
    ]


def _help(command: list[str]) -> str:
    runner = typer.testing.CliRunner()
    result = runner.invoke(cli.app, [*command, "--help"], prog_name="cadence", env={"COLUMNS": "110", "TERMINAL_WIDTH": "110"})
    text = "\n".join(line.rstrip() for line in result.stdout.strip().splitlines())
    return f"```text\n{text}\n```\n"


def _tables_of(cls: type[Any], name: str, described: dict[type[Any], str]) -> list[str]:
    """A table's keys and the tables inside it; what was `described` before, under the name kept there, is referred to."""
    summary = (inspect.getdoc(cls) or "").splitlines()[0]
    parts = [f"{summary}\n", _rows(cls)]
    hints, texts = typing.get_type_hints(cls), meanings(cls)
    seen: dict[type[Any], list[str]] = {}
    for field in dataclasses.fields(cls):
        nested = _nested(hints[field.name])
        if nested is not None:
            is_list = typing.get_origin(hints[field.name]) is tuple
            title = f"{name}.{field.name}"
            seen.setdefault(nested, []).append(f"[[{title}]]" if is_list else f"[{title}]")
    for nested, titles in seen.items():
        parts.append(f"### {', '.join(titles)}\n")
        leaf = titles[0].strip("[]").rpartition(".")[2]
        if texts.get(leaf):
            parts.append(f"{texts[leaf][0].upper()}{texts[leaf][1:]}.\n")
        if nested in described:
            parts.append(f"The same keys as {described[nested]}.\n")
        else:
            described[nested] = titles[0]
            parts += _tables_of(nested, titles[0].strip("[]"), described)
    return parts


def _rows(cls: type[Any]) -> str:
    rows = fields_of(cls)
    if not rows:
        return ""
    lines = ["| key | type | default | meaning |", "|---|---|---|---|"]
    lines += [f"| `{name}` | {kind} | {default} | {_cell(text)} |" for name, kind, default, text in rows]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _nested(hint: Any) -> type[Any] | None:
    """The dataclass inside a type hint, directly, optional, or in a tuple."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return hint
    return next((found for part in typing.get_args(hint) if (found := _nested(part)) is not None), None)


def _type(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    names = {float: "number", int: "integer", bool: "true or false", str: "text", Path: "path"}
    if hint in names:
        return names[hint]
    if origin is typing.Literal:
        return ", ".join(f"`{value}`" for value in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type(part) for part in arguments if part is not type(None))
    if origin is tuple:
        return (
            f"list of {_type(arguments[0])}" if arguments[-1] is Ellipsis else f"list of {len(arguments)} {_type(arguments[0])}"
        )
    return f"table of {_type(arguments[1])}" if origin is dict else str(hint)


def _default(field: "dataclasses.Field[Any]") -> str:
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    elif field.default is not dataclasses.MISSING:
        value = field.default
    else:
        return "must be given"
    if value is None:
        return "-"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, list | tuple):
        return f"`[{', '.join(map(repr, value))}]`".replace("'", '"')
    return f'`"{value}"`' if isinstance(value, str | Path) else f"`{value!r}`"


def main() -> int:
    """Write both pages."""
    for name, text in (("cli.md", cli_page()), ("configuration.md", configuration_page())):
        (ROOT / "docs" / name).write_text(text, encoding="utf-8", newline="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
