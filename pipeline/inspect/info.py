"""What a person wants to know of a log before using it: channels, rates, time range, health, and the settings that fit."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.accuracies import lines
from pipeline.catalogue import CatalogueChannel
from pipeline.counted import counted
from pipeline.ingest.writing import survey_channels
from pipeline.inspect.doctor import use_of
from pipeline.lengths import three_digits
from pipeline.logs.parts import recorded_parts
from pipeline.logs.reader import Health, open_log, open_parts, utc
from pipeline.mapping.guess import suggest_mapping
from pipeline.suspicions import few

_MAX_CHANNELS = 200
_UNITS = ("bytes", "kB", "MB", "GB", "TB")
_HEADINGS = ("topic", "schema", "encoding", "messages", "rate", "gap", "looks like")
_IS_NUMBER = (False, False, False, True, True, True, False)


@dataclass(frozen=True)
class LogDescription:
    """What `describe_log` found; times are log times, `roles` maps topics to what they look like.

    `accuracy` is what detections tell of theirs where messages do not.
    """

    path: Path
    size_bytes: int
    library: str
    start_ns: int
    end_ns: int
    duration_s: float
    channels: tuple[CatalogueChannel, ...]
    metadata_names: tuple[str, ...]
    health: Health
    suggested_mapping: str
    roles: dict[str, str] = field(default_factory=dict)
    accuracy: tuple[str, ...] = ()


def describe_log(path: Path | str) -> LogDescription:
    """The description of the log at `path`, a file or the folder of a split recording; `InputError` where it is no MCAP."""
    parts = recorded_parts(Path(path))
    log = open_parts(parts) if parts else open_log(path)
    suggested = suggest_mapping(log.channels)
    return LogDescription(
        path=log.path,
        size_bytes=log.size_bytes,
        library=log.library,
        start_ns=log.start_ns,
        end_ns=log.end_ns,
        duration_s=(log.end_ns - log.start_ns) / 1e9,
        channels=survey_channels(log),
        metadata_names=tuple(name for name, _ in log.metadata()),
        health=log.health,
        suggested_mapping=suggested.to_toml(),
        roles=dict(suggested.roles),
        accuracy=tuple(lines(use_of(log)[0].get("accuracy", []))),
    )


def render(description: LogDescription) -> str:
    """The description as text: head, health, table of channels, settings ready to paste."""
    parts = [
        "\n".join(_head(description)),
        "\n".join(_health(description.health)),
        "\n".join(_table(description)),
    ]
    notes = [f"  {channel.reason}" for channel in description.channels if channel.reason]
    if notes:
        parts.append("\n".join(["Not decodable (such channels are left out):", *notes]))
    if description.accuracy:
        told = "".join(f"\n  {line}" for line in few(description.accuracy))
        parts.append(f"Accuracy of the detections, where messages do not state it:{told}")
    if description.suggested_mapping:
        parts.append(f"Settings that fit; put them into a file and give it with --config:\n\n{description.suggested_mapping}")
    else:
        parts.append(
            "No channel looks like detections or truth. Name them in a file for --config, for example:\n\n"
            '[[extract.detections]]\ntopic = "/your/topic"\nx = "pose.position.x"\ny = "pose.position.y"\n'
        )
    return "\n\n".join(parts)


def _head(description: LogDescription) -> list[str]:
    lines = [f"{description.path}  ({_size(description.size_bytes)}, written by {description.library or 'unknown software'})"]
    if description.health.num_messages:
        lines.append(f"  from      {utc(description.start_ns)}")
        lines.append(f"  to        {utc(description.end_ns)}  ({_duration(description.duration_s)})")
    lines.append(f"  messages  {description.health.num_messages} on {counted(len(description.channels), 'channel')}")
    if description.metadata_names:
        lines.append(f"  metadata  {', '.join(dict.fromkeys(description.metadata_names))}")
    return lines


def _health(health: Health) -> list[str]:
    if not health.is_complete:
        lines = ["Health: DAMAGED; what follows is what could be read"]
    elif health.problems:
        lines = ["Health: all messages can be read, but the file has faults"]
    else:
        lines = ["Health: sound"]
    lines += [f"  {problem}" for problem in health.problems]
    if health.lost_spans_ns:
        lost_s = sum(end - start for start, end in health.lost_spans_ns) / 1e9
        lines.append(f"  Messages are missing in {len(health.lost_spans_ns)} time spans, {_duration(lost_s)} in all.")
    if not health.has_checksums:
        lines.append("  The file has no checksums: changed bytes inside messages could not be noticed.")
    return lines


def _table(description: LogDescription) -> list[str]:
    shown = sorted(description.channels, key=lambda channel: channel.topic)[:_MAX_CHANNELS]
    rows = [_HEADINGS, *(_row(channel, description.roles) for channel in shown)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADINGS))]
    lines = [_aligned(row, widths) for row in rows]
    if len(shown) < len(description.channels):
        lines.append(f"... and {len(description.channels) - len(shown)} more channels (all of them with --json)")
    return lines


def _row(channel: CatalogueChannel, roles: dict[str, str]) -> tuple[str, ...]:
    rate = "-" if channel.mean_rate_hz is None else f"{three_digits(channel.mean_rate_hz)} Hz"
    gap = "-" if channel.median_gap_s is None else f"{three_digits(channel.median_gap_s)} s"
    role = "-" if channel.is_decodable else "not decodable"
    if channel.is_decodable and channel.topic in roles:
        role = roles[channel.topic] + (f", frame {channel.frame_id}" if channel.frame_id else "")
    return channel.topic, channel.schema_name or "-", channel.encoding, str(channel.num_messages), rate, gap, role


def _aligned(row: Sequence[str], widths: Sequence[int]) -> str:
    cells = (
        cell.rjust(width) if is_number else cell.ljust(width)
        for cell, width, is_number in zip(row, widths, _IS_NUMBER, strict=True)
    )
    return "  ".join(cells).rstrip()


def _size(num_bytes: int) -> str:
    if num_bytes < 1000:
        return f"{num_bytes} bytes"
    power = min((len(str(num_bytes)) - 1) // 3, len(_UNITS) - 1)
    return f"{num_bytes / 1000**power:.1f} {_UNITS[power]}"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    clock = f"{hours}:{minutes:02d}:{rest:02d}"
    return f"{days} d {clock}" if days else clock
