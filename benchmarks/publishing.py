"""Publish what a script measured: tables as CSV, how they came about as JSON, and a section of a page, written from both.

For every script NAME `docs/benchmarks/data` holds NAME.json (its command, versions, seeds, counts) and NAME.csv or
NAME_MORE.csv (all that it measured). The script's `section` makes of them what stands on a page between `<!-- NAME begin -->`
and `<!-- NAME end -->`; everything else on a page is written by hand. So a rerun replaces its own numbers and nothing else.

    python -m benchmarks.publishing     write every section anew from the files, without measuring
"""

import csv
import importlib
import io
import json
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.files import write_atomic
from pipeline.provenance import versions

if TYPE_CHECKING:  # torch would enlarge the processes whose memory some scripts measure
    from cadence.metrics import Interval

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = {
    "real_logs": ("real_logs",),
    "answers": ("reliability",),
    "mission": ("mission",),
    "worlds": ("worlds",),
    "forecasts": ("table1", "table1_paper", "training_seeds", "narco_ceiling"),
    "sampling": ("sampler_speed", "place_samplers", "place_guidance", "inpainting_jumps", "inpainting_closed_form"),
    "network": ("rendezvous", "attention_cost", "place_ablations", "library_draws"),
    "association": ("association", "clutter"),
    "detections": ("measurement_noise", "height"),
    "evidence": ("silence", "bearings"),
    "logs": ("log_reading", "plausibility", "log_writing"),
    "runs": ("run_cost", "batch", "batch_engines", "memory", "many_agents"),
    "rivals": (),
}
"""The scripts whose sections stand on a page."""

Value = str | int | float | None
"""What a cell of a table may hold."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Measurement:
    """What a script measured: how (command, versions, counts), and tables by the name of their file."""

    name: str
    facts: dict[str, Any]
    tables: dict[str, list[Row]]

    def rows(self, more: str = "", **wanted: Value) -> list[Row]:
        """Rows of NAME_MORE.csv (NAME.csv without `more`) in which these columns have these values; none of a missing table."""
        rows = self.tables.get(f"{self.name}_{more}" if more else self.name, [])
        return [row for row in rows if all(row[column] == value for column, value in wanted.items())]


def facts_of(name: str, arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """The command of this process (or with these arguments), but for where it publishes, and the versions it ran with."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if "--publish" in words:
        at = words.index("--publish")
        del words[at : at + 2]
    return {"command": shlex.join(["python", "-m", f"benchmarks.{name}", *words]), "versions": versions()}


def publish(measured: Measurement, section: Callable[[Measurement], str], docs: Path | None) -> None:
    """Print the section as the files will make it; below `docs`, if given, write both."""
    as_kept = {name: from_csv(as_csv(rows)) for name, rows in measured.tables.items()}
    text = text_of(replace(measured, tables=as_kept), section)
    print(text)
    if docs is not None:
        write(measured, docs / "benchmarks" / "data")
        rewrite(_page(measured.name, docs), measured.name, text)


def text_of(measured: Measurement, section: Callable[[Measurement], str]) -> str:
    """The section, a remark on the measurement if somebody wrote one into its JSON, and where the numbers come from."""
    files = [f"[{name.removeprefix(f'{measured.name}_')}](data/{name}.csv)" for name in measured.tables]
    made = f"[made with](data/{measured.name}.json) `{measured.facts['command']}`"
    remarks = [f"**Remark.** {measured.facts['remark']}"] if "remark" in measured.facts else []
    return "\n\n".join([section(measured), *remarks, f"Numbers: {', '.join(files)}; {made}."])


def write(measured: Measurement, folder: Path) -> None:
    """The files of a measurement; those of an earlier one that are not written any more go."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in _files(measured.name, folder):
        path.unlink()
    for name, rows in measured.tables.items():
        write_atomic(folder / f"{name}.csv", as_csv(rows))
    facts = measured.facts | {"tables": list(measured.tables)}
    write_atomic(folder / f"{measured.name}.json", json.dumps(facts, indent=1, ensure_ascii=False) + "\n")


def as_csv(rows: Sequence[Row]) -> str:
    """Rows of the same columns, numbers with six digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows({column: _as_text(value) for column, value in row.items()} for row in rows)
    return text.getvalue()


def from_csv(text: str) -> list[Row]:
    """What `as_csv` wrote: numbers where a cell is one, None where it is empty."""
    return [{column: _as_value(cell) for column, cell in row.items()} for row in csv.DictReader(io.StringIO(text))]


def read(name: str, folder: Path) -> Measurement:
    """A measurement from its files."""
    facts = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    tables: dict[str, list[Row]] = {}
    for table in facts.pop("tables"):
        tables[table] = from_csv((folder / f"{table}.csv").read_text(encoding="utf-8"))
    return Measurement(name, facts, tables)


def rewrite(page: Path, name: str, text: str) -> None:
    """Replace what stands between the marks of `name`."""
    begin, end = f"<!-- {name} begin -->\n", f"\n<!-- {name} end -->"
    before, opened, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not opened or not closed:
        raise SystemExit(f"{page}: has no lines `{begin.strip()}` and `{end.strip()}`; put them where the section belongs")
    write_atomic(page, before + opened + text + closed + after)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    head, *body = ("| " + " | ".join(cells) + " |" for cells in [heads, *rows])
    return "\n".join([head, "|" + "---|" * len(heads), *body])


def columns(name: str, found: "Interval | None", factor: float = 1.0) -> Row:
    """An interval times a factor as columns NAME, NAME_low, NAME_high; without one they are empty."""
    if found is None:
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"))
    low, high = sorted((factor * found.low, factor * found.high))
    return {name: factor * found.value, f"{name}_low": low, f"{name}_high": high}


def interval(row: Row, column: str, digits: str = ".3g") -> str:
    """What `columns` wrote, as `value [low, high]`; a dash where there is nothing."""
    values = [row[name] for name in (column, f"{column}_low", f"{column}_high")]
    if values[0] is None:
        return "–"
    texts = [format(value, digits) for value in values if value is not None]
    return texts[0] if len(texts) < 3 else f"{texts[0]} [{texts[1]}, {texts[2]}]"


def main() -> int:
    """Write every section anew."""
    for page, names in PAGES.items():
        for name in names:
            section = importlib.import_module(f"benchmarks.{name}").section
            rewrite(DOCS / "benchmarks" / f"{page}.md", name, text_of(read(name, DOCS / "benchmarks" / "data"), section))
    return 0


def _page(name: str, docs: Path) -> Path:
    return docs / "benchmarks" / f"{next(page for page, names in PAGES.items() if name in names)}.md"


def _files(name: str, folder: Path) -> list[Path]:
    """What an earlier measurement wrote."""
    path = folder / f"{name}.json"
    if not path.is_file():
        return []
    return [path, *(folder / f"{table}.csv" for table in json.loads(path.read_text(encoding="utf-8"))["tables"])]


def _as_text(value: Value) -> str:
    if value is None or value != value:  # None or NaN
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _as_value(text: str) -> Value:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text or None


if __name__ == "__main__":
    sys.exit(main())
