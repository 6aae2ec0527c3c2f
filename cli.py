"""The command line: flags to one call into `pipeline` to an exit code. No logic; heavy imports wait for their command."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

from cadence.errors import CadenceError, DeviceError, PartialInputError, UsageError
from pipeline.batch.summaries import batch_summary, log_record, stage_exit_code, stage_summary, to_json
from pipeline.config import stage_config
from pipeline.manifest import StageResult
from pipeline.missions import mission_directories
from pipeline.out_of_memory import ADVICE, is_out_of_memory
from pipeline.progress import Progress
from pipeline.stores.urls import masked

EXIT_INTERRUPTED = 130
_COMBINED = ["export.combined=true"]
_STRICT = ["extract.is_strict=true", "infer.is_strict=true"]

app = typer.Typer(
    name="cadence",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
    help="""From mission logs in which targets are seen only now and then to weighted joint tracks, past and future.

    \b
      cadence info LOG.mcap                 what is in a log, and the settings that fit it
      cadence import TABLE --out LOG.mcap   a log of CSV, Parquet or GeoJSON
      cadence run LOG.mcap --out results    everything: side file for Foxglove, layout, report
      cadence view results/LOG              the report, in a browser
      cadence COMMAND --help                options and examples of one command

    Exit codes: 0 ok, 1 defect, 2 wrong call, 3 unusable input, 4 configuration, 5 device or storage, 7 damaged input,
    8 suspected input, 130 interrupted.
    """,
)

Log = Annotated[Path, typer.Argument(metavar="LOG", help="Mission log (MCAP).", show_default=False)]
Logs = Annotated[
    list[str],
    typer.Argument(metavar="LOG", help="Mission logs (MCAP), folders, patterns or URLs of them.", show_default=False),
]
LocalLogs = Annotated[
    list[str], typer.Argument(metavar="LOG", help="Mission logs (MCAP), folders or patterns of them.", show_default=False)
]
Mission = Annotated[
    Path, typer.Argument(metavar="MISSION", help="Mission directory, as written by ingest or run.", show_default=False)
]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results; made where it is absent.")]
RunOut = Annotated[str, typer.Option("--out", metavar="DIR", help="Folder or URL for the results.")]
Workers = Annotated[
    int | None, typer.Option(metavar="N", help="Cores to use, for many logs and inside each; 0: one, here; default: all.")
]
Engine = Annotated[Literal["local", "ray"], typer.Option(help="Where the work is done: here, or on Ray (RAY_ADDRESS).")]
Start = Annotated[str | None, typer.Option(metavar="T", help="Use nothing before T: extract.start.")]
End = Annotated[str | None, typer.Option(metavar="T", help="Use nothing after T: extract.end.")]
Topic = Annotated[list[str] | None, typer.Option(metavar="PATTERN", help="Use only such topics: extract.topics; repeatable.")]
Report = Annotated[str | None, typer.Option(metavar="FILE", help="Write the outcome of every log as JSON there, too.")]
Config = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="TOML file with one table a stage (docs/configuration.md).")
]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting, as in infer.num_hypotheses=50; repeatable.")
]
Combined = Annotated[bool, typer.Option("--combined", help="Also write one file that holds the log and the results.")]
Strict = Annotated[bool, typer.Option("--strict", help="Refuse logs of which something is suspected: is_strict of a stage.")]
Force = Annotated[bool, typer.Option("--force", help="Do it again even where nothing has changed.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress on stderr; errors only.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
Seed = Annotated[
    int | None, typer.Option("--seed", metavar="N", help="Seed of everything random; the same seed repeats the result.")
]
Columns = Annotated[
    list[str] | None,
    typer.Option("--column", metavar="FIELD=COLUMN", help="What a column holds, also FIELD=COLUMN:UNIT; FIELD= leaves it out."),
]
Zone = Annotated[str, typer.Option(metavar="ZONE", help="Of times that state none: UTC, +02:00, Europe/Paris.")]
TimeForm = Annotated[
    str, typer.Option("--time", metavar="FORM", help="s, ms, us, ns; day-first, month-first; or '%d/%m/%Y %H:%M'.")
]
Zero = Annotated[str | None, typer.Option(metavar="MOMENT", help="When times that are numbers count from, with its zone.")]
Unit = Annotated[str, typer.Option(metavar="UNIT", help="Of positions: deg, rad, '1e-7 deg', ddmm.mm; m, km, ft.")]
Agent = Annotated[str, typer.Option(metavar="NAME", help="Who was seen, in all rows.")]
SensorName = Annotated[str, typer.Option("--sensor", metavar="NAME", help="Who saw it, in all rows.")]
Sigma = Annotated[float | None, typer.Option(metavar="METRES", help="Standard deviation where the table states none.")]
Table = Annotated[Path, typer.Argument(metavar="TABLE", help="CSV, Parquet or GeoJSON of positions.", show_default=False)]
LogOut = Annotated[
    Path | None, typer.Option("--out", metavar="LOG.mcap", help="The log; without it the table is only looked at.")
]
ViewTarget = Annotated[str, typer.Argument(metavar="LOG|RESULTS", help="A log, or what run made of one.", show_default=False)]
ViewOut = Annotated[str, typer.Option("--out", metavar="DIR", help="Folder for the results of a log.")]
Served = Annotated[bool, typer.Option("--serve", help="Serve the folder to this machine, and print the address.")]
Port = Annotated[int, typer.Option(metavar="N", min=0, max=65535, help="Port to serve at; 0: a free one.")]
TakeTo = Annotated[
    list[str] | None, typer.Option("--to", metavar="FORMATS", help="Formats for other programs, with commas; repeatable.")
]
TakeOut = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="With --to: folder for the files; default: MISSION.")
]
Source = Annotated[
    Literal["mission", "windows"] | None,
    typer.Option("--from", help="With --to: mission hypotheses or windows; default: the first that is there."),
]
Drawn = Annotated[
    int | None, typer.Option(metavar="N", help="With --to: hypotheses, the heaviest; default: 30, in GeoParquet all.")
]
Before = Annotated[float | None, typer.Option(metavar="S", help="Begin so long before an agent's first detection.")]
After = Annotated[float | None, typer.Option(metavar="S", help="End so long after an agent's last detection.")]
Checkpoint = Annotated[str | None, typer.Option(metavar="NAME", help="Evaluate its forecasts on the logs in MISSION.")]
ForecastOut = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="For the forecasts' scores; default: MISSION.")]


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print versions and leave.")] = False
) -> None:
    if version:
        from pipeline.provenance import versions

        typer.echo(", ".join(f"{name} {number}" for name, number in versions().items()))
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def info(log: Log, as_json: Json = False) -> int:
    """Show what is in a log, and the settings that fit it.

    Channels, schemas, rates, time range, health; which channels look like detections, truth, frames or obstacles. Exit
    code 7 where messages are lost, or may be.

    \b
    Examples:
      cadence info flight.mcap
      cadence info flight.mcap --json
    """
    from pipeline.inspect.info import describe_log, render

    description = describe_log(log)
    typer.echo(to_json(description) if as_json else render(description))
    return 0 if description.health.is_complete else PartialInputError.exit_code


@app.command()
def doctor(logs: LocalLogs, quiet: Quiet = False, as_json: Json = False) -> int:
    """Say what is wrong with a log, and what to do.

    Damage and lost time spans, index and checksums, clocks and gaps, channels that cannot be decoded, what `cadence run`
    would take, what it would suspect. Exit code 0: every message can be read and nothing is suspected; 8: something is; 7:
    messages are lost, or may be; 3: no message can be read.

    \b
    Examples:
      cadence doctor flight.mcap
      cadence doctor logs --json
    """
    from pipeline.inspect.doctor import diagnose_all, exit_code, render

    found = diagnose_all(logs, Progress(quiet))
    typer.echo(to_json(found) if as_json else "\n\n".join(map(render, found)))
    return exit_code(found)


@app.command("import")
def import_(
    table: Table, out: LogOut = None, column: Columns = None, time: TimeForm = "", zone: Zone = "", zero: Zero = None,
    unit: Unit = "", agent: Agent = "", sensor: SensorName = "", sigma: Sigma = None, force: Force = False,
    quiet: Quiet = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Make a log of a table of positions.

    CSV, Parquet or GeoJSON of points, with a time and a position a row. What each column holds is guessed and shown; what is
    in doubt is refused. Fields: time, date, latitude, longitude, north_south, east_west, x, y, altitude, agent, sensor,
    sigma, cov_xx, cov_xy, cov_yy, truth.

    \b
    Examples:
      cadence import AIS_2026_11_28.csv
      cadence import AIS_2026_11_28.csv --out ais.mcap
      cadence import plots.csv --out plots.mcap --column time=T --zone Europe/Paris --time day-first --sigma 25
      cadence import run7.parquet --out run7.mcap --zero 2026-05-01T12:00:00Z --time s --column x=px --column y=py
    """
    from pipeline.importing.shown import render
    from pipeline.importing.stage import import_settings, import_table

    settings = import_settings(column or (), time, zone, zero, unit, agent, sensor, sigma)
    imported = import_table(table, out, settings, Progress(quiet), force)
    typer.echo(to_json(imported) if as_json else render(imported))


@app.command()
def run(
    logs: Logs, out: RunOut, workers: Workers = None, engine: Engine = "local", start: Start = None, end: End = None,
    topic: Topic = None, combined: Combined = False, strict: Strict = False, report: Report = None, config: Config = None,
    settings: Set = None, seed: Seed = None, force: Force = False, quiet: Quiet = False, as_json: Json = False,
) -> int:  # fmt: skip
    """Run all stages on every log.

    Ingest, extract, infer, retrospect, export, report; finished stages are skipped. Folders are searched for logs, parts of a
    split recording are one mission. Each gets the mission directory DIR/<its name>; what became of all is in DIR/batch.json.
    One bad log does not stop the others; the exit code is the highest of the failures; without any it is 8 where results rest
    on a suspicion, or 7 where only damaged logs are amiss.
    That nothing was detected in a log is no failure, unless nothing was detected in any of them (3).

    \b
    Examples:
      cadence run flight.mcap --out results
      cadence run logs --out results --workers 4 --config ships.toml
      cadence run 'logs/2026-*/*.mcap' --out results --report night.json --quiet
      cadence run s3://fleet/2026-11 --out s3://fleet/tracks --engine ray
      cadence run flight.mcap --out results --set infer.num_hypotheses=50 --seed 7
    """
    from pipeline.batch.config import RunConfig
    from pipeline.batch.outcome import complaints, exit_code
    from pipeline.batch.run import run as run_all
    from pipeline.batch.run import selection_settings

    chosen = [*(settings or ()), *_COMBINED * combined, *_STRICT * strict, *selection_settings(start, end, topic or ())]
    resolved = stage_config(RunConfig, None, config, chosen, seed)
    unwritten: list[CadenceError] = []
    outcomes = run_all(logs, out, resolved, Progress(quiet), force, engine, workers, report, unwritten.append)
    failures = complaints(outcomes)
    typer.echo(to_json([log_record(outcome) for outcome in outcomes]) if as_json else batch_summary(outcomes, failures))
    for complaint in (*failures, *map(str, unwritten)):
        _complain(complaint)
    return exit_code(outcomes, unwritten)


@app.command()
def ingest(
    log: Log, out: Out, config: Config = None, settings: Set = None, force: Force = False, quiet: Quiet = False,
    as_json: Json = False,
) -> int:  # fmt: skip
    """Stage 1: catalogue a log.

    Channels, rates, health and a suggested mapping go into the mission directory DIR/<name of the log>. Exit code 7 where
    messages are lost, or may be.

    \b
    Example:
      cadence ingest flight.mcap --out results
    """
    from pipeline.ingest.stage import IngestConfig
    from pipeline.ingest.stage import ingest as stage

    directory = mission_directories([log], out)[log]
    resolved = stage_config(IngestConfig, "ingest", config, settings or ())
    return _show(stage(log, directory, resolved, Progress(quiet), force), as_json)


@app.command()
def extract(
    mission: Mission, strict: Strict = False, config: Config = None, settings: Set = None, seed: Seed = None,
    force: Force = False, quiet: Quiet = False, as_json: Json = False,
) -> int:  # fmt: skip
    """Stage 2: get the detections out of the log.

    Detections, truth, sensor poses and obstacles, in one metric frame. Exit code 7 where the log is damaged.

    \b
    Examples:
      cadence extract results/flight
      cadence extract results/flight --config mapping.toml --force
    """
    from pipeline.extract.config import ExtractConfig
    from pipeline.extract.stage import extract as stage

    resolved = stage_config(ExtractConfig, "extract", config, [*(settings or ()), *_STRICT[:1] * strict], seed)
    return _show(stage(mission, resolved, Progress(quiet), force), as_json)


@app.command()
def infer(
    mission: Mission, strict: Strict = False, config: Config = None, settings: Set = None, seed: Seed = None,
    force: Force = False, quiet: Quiet = False, as_json: Json = False,
) -> int:  # fmt: skip
    """Stage 3: draw weighted hypotheses, past and future.

    Exit code 8 where the checkpoint does not fit the log, so that the default one took its place.

    \b
    Example:
      cadence infer results/flight --set infer.num_hypotheses=50 --seed 7
    """
    from pipeline.infer.config import InferConfig
    from pipeline.infer.stage import infer as stage

    resolved = stage_config(InferConfig, "infer", config, [*(settings or ()), *_STRICT[1:] * strict], seed)
    return _show(stage(mission, resolved, Progress(quiet), force), as_json)


@app.command()
def retrospect(
    mission: Mission, before: Before = None, after: After = None, config: Config = None, settings: Set = None,
    seed: Seed = None, force: Force = False, quiet: Quiet = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Stage 4: draw mission hypotheses.

    Whole tracks of all agents from first to last detection, given all detections: the same hypothesis is the same story from
    beginning to end. Writes mission.parquet.

    \b
    Examples:
      cadence retrospect results/flight
      cadence retrospect results/flight --before 600 --after 600 --set retrospect.num_hypotheses=1000
    """
    from pipeline.retrospect.config import RetrospectConfig
    from pipeline.retrospect.stage import retrospect as stage

    around = [f"retrospect.{name}_s={value}" for name, value in (("before", before), ("after", after)) if value is not None]
    resolved = stage_config(RetrospectConfig, "retrospect", config, [*(settings or ()), *around], seed)
    _show(stage(mission, resolved, Progress(quiet), force), as_json)


@app.command()
def export(
    mission: Mission, to: TakeTo = None, out: TakeOut = None, source: Source = None, hypotheses: Drawn = None,
    combined: Combined = False, config: Config = None, settings: Set = None, force: Force = False, quiet: Quiet = False,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Stage 5: write the files for Foxglove, or others.

    The side file NAME.cadence.mcap, to be opened together with the log, and a layout to import. With --to nothing of that, but
    tracks with their times and weights, means, and regions that hold 50 and 90 %; formats: geoparquet, geojson, kml, czml,
    gpx, cot, rerun (a blueprint). All but geoparquet and rerun need latitude and longitude.

    \b
    Examples:
      cadence export results/flight --combined
      cadence export results/flight --to geojson,kml
      cadence export results/flight --to geoparquet --out tables --from windows
    """
    if to:
        from pipeline.takeaway.stage import render, take_away

        taken = take_away(mission, to, out, hypotheses, source, Progress(quiet))
        typer.echo(to_json(taken) if as_json else render(taken))
        return
    from pipeline.export.config import ExportConfig
    from pipeline.export.stage import export as stage

    resolved = stage_config(ExportConfig, "export", config, [*(settings or ()), *_COMBINED * combined])
    _show(stage(mission, resolved, Progress(quiet), force), as_json)


@app.command()
def report(
    mission: Mission, config: Config = None, settings: Set = None, force: Force = False, quiet: Quiet = False,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Stage 6: write report.html, a page for any browser.

    \b
    Example:
      cadence report results/flight
    """
    from pipeline.report.config import ReportConfig
    from pipeline.report.stage import report as stage

    _show(
        stage(mission, stage_config(ReportConfig, "report", config, settings or ()), Progress(quiet), force),
        as_json,
    )


@app.command()
def evaluate(
    mission: Mission, checkpoint: Checkpoint = None, out: ForecastOut = None, config: Config = None, settings: Set = None,
    seed: Seed = None, force: Force = False, quiet: Quiet = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Score hypotheses or forecasts against the truth.

    Beside rivals. A folder of missions gets a pooled table; --checkpoint forecasts on a folder of logs, as in the paper.

    \b
    Examples:
      cadence evaluate results/flight
      cadence evaluate logs --checkpoint prison --out scores
    """
    from pipeline.evaluate.stage import EvaluateConfig, evaluate_any

    resolved = stage_config(EvaluateConfig, "evaluate", config, settings or (), seed)
    _show(evaluate_any(mission, checkpoint, out, resolved, Progress(quiet), force), as_json)


class _Command(TyperCommand):
    def format_options(self, ctx: typer.Context, formatter: Any) -> None:  # type: ignore[override]
        for param in self.params:  # arguments are named without their types in Python
            if isinstance(param, TyperArgument):
                param.display_type_rich = lambda ctx: None  # type: ignore[method-assign]
        super().format_options(ctx, formatter)


class _Missions(TyperGroup):
    """All words before the question are missions: a pattern of the shell makes several of one."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """The rest of the words, behind the first mission; all missions are kept in `ctx.meta`."""
        asked = next((number for number, word in enumerate(args) if number and word in self.commands), 1)
        ctx.meta["missions"] = [Path(word) for word in args[:asked]]
        return super().parse_args(ctx, args[:1] + args[asked:])

    def resolve_command(self, ctx: typer.Context, args: list[str]) -> Any:  # type: ignore[override]
        """The question; `UsageError` where it is a path."""
        if Path(args[0]).exists() and args[0] not in self.commands:
            raise UsageError(f"ask: no question behind {args[0]}; name one of {', '.join(self.commands)}")
        return super().resolve_command(ctx, args)


questions = typer.Typer(
    name="ask",
    cls=_Missions,
    add_completion=False,
    rich_markup_mode=None,
    no_args_is_help=True,
    help="""Ask where it was, when it arrived, whether two met.

    Answers come from mission hypotheses (given all that was detected), or with --as-of from what was known at a moment. AREA is
    a GeoJSON file or text, a circle `latitude,longitude,metres` (`x,y,metres` where the log is not georeferenced), or the name
    of an obstacle; LINE likewise, or two points and more. Times are ISO 8601, a time of day (UTC), or seconds after the log
    begins. Several missions are asked one after the other.

    \b
    Examples:
      cadence ask results/flight where --at 10:12:30 --out places
      cadence ask results/* where --at 600
      cadence ask results/flight inside 50.76,-1.29,2000 --from 10:00 --to 11:00 --dwell 600
      cadence ask results/flight meet --within 500 --for 60 --json
    """,
)
app.add_typer(questions, name="ask")
_MINUS = {"ignore_unknown_options": True}  # southern latitudes begin with a minus
OneAgent = Annotated[str | None, typer.Option("--agent", metavar="NAME", help="Only this agent; default: each.")]
From = Annotated[str | None, typer.Option("--from", metavar="T", help="Not before T; default: the beginning.")]
To = Annotated[str | None, typer.Option("--to", metavar="T", help="Not after T; default: the end.")]
AsOf = Annotated[str | None, typer.Option("--as-of", metavar="T", help="From what was known at T, not from all.")]
Area = Annotated[str, typer.Argument(metavar="AREA", help="GeoJSON, a circle, or an obstacle's name.", show_default=False)]


@questions.callback()
def _ask(context: typer.Context, mission: Mission) -> None:
    context.obj = context.meta["missions"]


def _answer(context: typer.Context, as_json: bool, out: Path | None = None, **stated: object) -> int:
    from pipeline.ask.question import Question
    from pipeline.ask.spoken import ask_each

    return ask_each(context.obj, Question.asked(**stated), out, as_json, typer.echo, _complain, Progress().note)


@questions.command()
def where(
    context: typer.Context, at: Annotated[str, typer.Option("--at", metavar="T", help="The moment.", show_default=False)],
    agent: OneAgent = None, as_of: AsOf = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Write GeoJSON, GeoTIFF and a map there.")] = None,
    as_json: Json = False,
) -> int:  # fmt: skip
    """Where it was: areas that hold 50, 90 and 95 %."""
    return _answer(context, as_json, out, ask="where", at=at, agent=agent, as_of=as_of)


@questions.command(context_settings=_MINUS)
def inside(
    context: typer.Context, area: Area, start: From = None, end: To = None,
    dwell: Annotated[float, typer.Option("--dwell", metavar="S", help="For so many seconds without a break.")] = 0.0,
    agent: OneAgent = None, as_of: AsOf = None, as_json: Json = False,
) -> int:  # fmt: skip
    """Whether it was in AREA, since when, until when."""
    return _answer(context, as_json, ask="inside", area=area, start=start, end=end, dwell_s=dwell, agent=agent, as_of=as_of)


@questions.command(context_settings=_MINUS)
def arrive(
    context: typer.Context, area: Area, start: From = None, end: To = None, agent: OneAgent = None, as_of: AsOf = None,
    as_json: Json = False,
) -> int:  # fmt: skip
    """Whether it came into AREA from outside, when, and where over its border."""
    return _answer(context, as_json, ask="arrive", area=area, start=start, end=end, agent=agent, as_of=as_of)


@questions.command(context_settings=_MINUS)
def passed(
    context: typer.Context,
    line: Annotated[str, typer.Argument(metavar="LINE", help="GeoJSON, or points 'A,B C,D'.", show_default=False)],
    start: From = None, end: To = None, agent: OneAgent = None, as_of: AsOf = None, as_json: Json = False,
) -> int:  # fmt: skip
    """Whether it crossed LINE, when, where, and to which side."""
    return _answer(context, as_json, ask="passed", line=line, start=start, end=end, agent=agent, as_of=as_of)


@questions.command()
def meet(
    context: typer.Context,
    agents: Annotated[list[str] | None, typer.Argument(metavar="A B", help="Two agents; default: all pairs.")] = None,
    within: Annotated[float, typer.Option("--within", metavar="M", help="Metres.", show_default=False)] = ...,  # type: ignore[assignment]
    during: Annotated[float, typer.Option("--for", metavar="S", help="Seconds without a break.")] = 0.0,
    every: Annotated[bool, typer.Option("--all", help="All pairs, as without names.")] = False,
    start: From = None, end: To = None, as_of: AsOf = None, as_json: Json = False,
) -> int:  # fmt: skip
    """Whether two came within M metres of each other, when and where."""
    one, other = [*(agents or ()), None, None][:2]
    if len(agents or ()) > 2 or (agents and every):
        raise UsageError("meet is about two agents, or about all")
    return _answer(
        context, as_json, ask="meet", agent=one, other=other, within_m=within, for_s=during, start=start, end=end, as_of=as_of
    )


@questions.command()
def same(
    context: typer.Context,
    one: Annotated[str, typer.Argument(metavar="A", help="An agent, or #N: row N of the detections.", show_default=False)],
    other: Annotated[str, typer.Argument(metavar="B", help="Another one.", show_default=False)],
    within: Annotated[float | None, typer.Option("--within", metavar="M", help="Further apart they are two.")] = None,
    as_of: AsOf = None, as_json: Json = False,
) -> int:  # fmt: skip
    """How likely two detections, or two tracks, are of one target."""
    return _answer(context, as_json, ask="same", agent=one, other=other, within_m=within, as_of=as_of)


@questions.command()
def searched(
    context: typer.Context,
    start: From = None,
    end: To = None,
    agent: OneAgent = None,
    as_of: AsOf = None,
    as_json: Json = False,
) -> int:
    """How much of where it may have been the sensors swept, and where one more look would have paid most."""
    return _answer(context, as_json, ask="searched", start=start, end=end, agent=agent, as_of=as_of)


@app.command()
def view(
    target: ViewTarget, out: ViewOut = "results", served: Served = False, port: Port = 0, config: Config = None,
    settings: Set = None, force: Force = False, quiet: Quiet = False,
) -> int:  # fmt: skip
    """Open the report in a browser.

    Of a log what is missing is run first, into DIR/<its name>; results keep the settings that they were made with. Where
    there is no browser, or with --serve, the folder is served to this machine alone, until Ctrl-C; a folder of missions is
    served with a list of them.

    \b
    Examples:
      cadence view flight.mcap
      cadence view results/flight
      cadence view results --serve --port 8080
    """
    from pipeline.view.stage import view as show

    return show(target, out, config, settings or (), Progress(quiet), typer.echo, _complain, served, port, force)


@app.command()
def simulate(
    out: Out, config: Config = None, settings: Set = None, seed: Seed = None, force: Force = False, quiet: Quiet = False,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Write mission logs from a simulated world.

    A moving target, moving sensors, sparse detections, obstacles, and the truth.

    \b
    Examples:
      cadence simulate --out logs --seed 7
      cadence simulate --out logs --set simulate.num_episodes=20 --set simulate.patrol.detection_rate=0.12
      cadence simulate --out logs --set simulate.world=prison --set simulate.prison.set=high
    """
    from pipeline.simulate.stage import SimulateConfig
    from pipeline.simulate.stage import simulate as stage

    _show(stage(out, stage_config(SimulateConfig, "simulate", config, settings or (), seed), Progress(quiet), force), as_json)


@app.command()
def train(
    out: Out, config: Config = None, settings: Set = None, seed: Seed = None, force: Force = False, quiet: Quiet = False,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Train a checkpoint.

    From a folder of logs with truth, or from the simulator. An interrupted training goes on where it was, unless --force.

    \b
    Examples:
      cadence train --out runs/general --seed 1
      cadence train --out runs/ships --config ships.toml
    """
    from pipeline.train.config import TrainConfig
    from pipeline.train.stage import train as stage

    _show(stage(out, stage_config(TrainConfig, "train", config, settings or (), seed), Progress(quiet), force), as_json)


for _command in (*app.registered_commands, *questions.registered_commands):
    _command.cls = _Command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; foreseen failures are one line on stderr, defects keep their traceback."""
    try:
        code = app(args=arguments, prog_name="cadence", standalone_mode=False)
        sys.stdout.flush()
    except CadenceError as error:
        _complain(error)
        return error.exit_code
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        said = error.format_message().replace("Value error, ", "").rstrip(".")
        _complain(UsageError(f"{said}; see {context.command_path if context else 'cadence'} --help"))
        return UsageError.exit_code
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        _complain(ADVICE)
        return DeviceError.exit_code
    except BrokenPipeError:
        # The reader (head, less) has what it wanted; what Python would still flush at exit goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    if code == EXIT_INTERRUPTED:
        typer.echo("cadence: interrupted; finished stages are kept, the same command continues after them", err=True)
    return code if isinstance(code, int) else 0


def _complain(error: CadenceError | str) -> None:
    typer.echo(f"cadence: error: {masked(' '.join(str(error).split()))}", err=True)


def _show(result: StageResult, as_json: bool) -> int:
    """Print what a stage did; its exit code."""
    typer.echo(to_json(result) if as_json else stage_summary(result))
    return stage_exit_code(result)


if __name__ == "__main__":
    sys.exit(main())
