"""`cadence export MISSION --to FORMATS`: results as files that other programs take."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cadence.errors import InputError, UsageError
from pipeline.catalogue import read_catalogue
from pipeline.counted import counted
from pipeline.files import replacing
from pipeline.progress import Progress
from pipeline.suggestions import did_you_mean
from pipeline.takeaway.answer import Answer, Source, read_answer
from pipeline.takeaway.cot import cot_text
from pipeline.takeaway.czml import czml_text
from pipeline.takeaway.geojson import geojson_text
from pipeline.takeaway.geoparquet import write_regions, write_steps
from pipeline.takeaway.gpx import gpx_text
from pipeline.takeaway.kml import kml_text
from pipeline.takeaway.rerun_blueprint import write_blueprint

NUM_DRAWN = 30
"""Hypotheses in formats that are drawn; GeoParquet holds all."""

_TEXTS: dict[str, tuple[str, Callable[[Answer, int], Iterator[str]]]] = {
    "geojson": ("geojson", geojson_text),
    "kml": ("kml", kml_text),
    "czml": ("czml", czml_text),
    "gpx": ("gpx", gpx_text),
    "cot": ("cot", lambda answer, number: cot_text(answer)),
}
"""The ending and the text of each format that needs latitude and longitude."""
FORMATS = ("geoparquet", *_TEXTS, "rerun")


@dataclass(frozen=True)
class TakenAway:
    """The files that were written, and from what: mission hypotheses or windows."""

    source: Source
    num_agents: int
    files: tuple[Path, ...]


def take_away(
    directory: Path,
    formats: Sequence[str],
    out: Path | None,
    num_hypotheses: int | None,
    source: Source | None,
    progress: Progress,
) -> TakenAway:
    """Write the results of a mission directory as files of some formats, into `out` or beside the results.

    Raises `UsageError` for an unknown format, `InputError` where there are no results, or a format needs latitude and longitude
    that the log does not have. Files are there as a whole or not at all; nothing is written where one format is refused.
    """
    chosen = read_formats(formats)
    if num_hypotheses is not None and num_hypotheses < 1:
        raise UsageError(f"--hypotheses {num_hypotheses}: must be at least 1")
    answer = read_answer(directory, read_catalogue(directory).name, source)
    in_degrees = [name for name in chosen if name in _TEXTS]
    if in_degrees and not answer.frame.is_georeferenced:
        raise InputError(
            f"{directory}: {', '.join(in_degrees)} needs latitude and longitude, and the log is in metres; geoparquet works, "
            "or set extract.datum to where its zero lies and run it again"
        )
    folder, written = directory if out is None else out, []
    with progress.bar(len(chosen), "export", "file") as bar:
        for name in chosen:
            written += list(_write(answer, name, folder, num_hypotheses))
            bar.update()
    return TakenAway(answer.source, len(answer.agent_ids), tuple(written))


def read_formats(texts: Sequence[str]) -> tuple[str, ...]:
    """The formats in `geojson,kml`, each once; `UsageError` for one that is not known."""
    names = tuple(dict.fromkeys(name.strip().lower() for text in texts for name in text.split(",") if name.strip()))
    for name in names:
        if name not in FORMATS:
            raise UsageError(f"--to {name}: not known{did_you_mean(name, FORMATS)}; formats: {', '.join(FORMATS)}")
    if not names:
        raise UsageError(f"--to: names no format; formats: {', '.join(FORMATS)}")
    return names


def _write(answer: Answer, name: str, folder: Path, num_hypotheses: int | None) -> Iterator[Path]:
    if name == "geoparquet":
        steps, regions = folder / f"{answer.name}.tracks.parquet", folder / f"{answer.name}.regions.parquet"
        with replacing(steps) as draft:
            write_steps(answer, draft, num_hypotheses)
        with replacing(regions) as draft:
            write_regions(answer, draft)
        yield from (steps, regions)
        return
    if name == "rerun":
        path = folder / f"{answer.name}.rbl"
        with replacing(path) as draft:
            write_blueprint(answer, draft)
        yield path
        return
    ending, text = _TEXTS[name]
    path = folder / f"{answer.name}.{ending}"
    with replacing(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        for part in text(answer, num_hypotheses or NUM_DRAWN):
            file.write(part)
    yield path


def render(taken: TakenAway) -> str:
    """What was written, as text."""
    of = "mission hypotheses" if taken.source == "mission" else "windows (cadence retrospect makes mission hypotheses)"
    lines = [f"{counted(taken.num_agents, 'agent')}, from {of}"]
    return "\n".join(lines + [f"  {path}  ({path.stat().st_size} bytes)" for path in taken.files])
