"""How sound the log was, and what the extract stage could not use."""

from collections.abc import Mapping
from typing import Any

from pipeline.accuracies import in_words
from pipeline.clock import Clock, duration
from pipeline.height_words import height_words
from pipeline.lengths import three_digits
from pipeline.logs.reader import Health
from pipeline.measurement_words import measurement_words
from pipeline.report.markup import flatten, label, pairs, section, table, text
from pipeline.report.mission import Mission

MAX_CHANNELS = 200
MAX_ENTRIES = 50

FACTS = {
    "num_messages": "messages read",
    "num_messages_expected": "messages that the recorder wrote",
    "has_checksums": "checksums, to notice changed bytes",
}
"""Facts of the catalogue's health in words."""

CHANNEL = {
    "topic": "topic",
    "schema_name": "type",
    "encoding": "encoding",
    "num_messages": "messages",
    "mean_rate_hz": "rate (Hz)",
    "frame_id": "frame",
    "reason": "why it cannot be decoded",
}
"""What is told of channels of the catalogue, in words."""

EXTRACTED = {
    "num_agents": "agents named",
    "num_detections": "detections",
    "sources.detections": "detections from",
    "num_unknown_origin": "detections without a named agent",
    "num_truth": "positions of the truth",
    "sources.truth": "truth from",
    "num_poses": "positions of sensors",
    "sources.poses": "sensors from",
    "num_obstacles": "obstacles",
    "span_s": "from the first to the last detection (s)",
}
"""What extract found, in words."""

LEFT_OUT = {
    "collapsed": "simultaneous detections merged into others",
    "disagreeing": "simultaneous detections that do not agree with the most accurate one, left out",
    "undecodable": "messages that cannot be decoded",
    "incomplete": "messages without a position where the mapping looks",
    "no_fix": "positions marked as having no fix, or as not valid",
    "unmet": "positions that do not meet the conditions of where",
    "dropped_nonfinite": "positions that are NaN, infinite or off the earth",
    "bad_covariance": "covariances that were replaced by the default",
    "disowned_covariance": "covariances that are called unknown by their type, not used",
    "out_of_order": "time stamps out of order, sorted",
    "outside_time_cut": "positions outside the chosen time span",
    "other_frame": "positions in another frame, left out",
    "spikes": "positions far off their track, left out",
    "duplicate_truth": "repeated truth positions, left out",
}
"""Counts of extract's summary in words."""


def health_section(mission: Mission) -> str:
    """Completeness, problems, lost spans, counts of extract, and the channels."""
    health = mission.catalogue.health
    content = _verdict(health) + _problems(health) + _lost_spans(mission, health)
    left = f"<div><h3>Log</h3>{pairs([(text(words), text(getattr(health, key))) for key, words in FACTS.items()])}</div>"
    summary = mission.manifests.get("extract", {}).get("summary") or {}
    rows = _extraction(summary)
    right = f"<div><h3>Extraction</h3>{pairs(rows)}</div>" if rows else ""
    content += f'<div class="columns">{left}{right}</div>' + _channels(mission)
    return section("Health of the log", content)


def _extraction(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What extract counted: what was left out in words, the rest by its name."""
    counted = {words: summary[key] for key, words in LEFT_OUT.items() if key in summary}
    rows = [(text(words), text(count)) for words, count in counted.items() if count]
    if counted and not rows:
        rows = [("left out", "nothing")]
    for who, words in map(in_words, summary.get("accuracy") or []):
        rows.append(("accuracy, where none is stated", text(f"{who}: {words}")))
    for line in summary.get("taken") or []:
        rows.append(("accuracy, where none is stated", text(line)))
    if words := measurement_words(summary.get("measurements") or {}):
        rows.append(("bearings and ranges", text(words)))
    if height := summary.get("height"):
        rows.append(("heights", text(height_words(height).removeprefix("heights are "))))
    unused = summary.get("unused") or {}
    rows += [("may hold detections, not used", text(f"{channel}: {why}")) for channel, why in unused.items()]
    # Other parts of the page tell of these already.
    known = {*LEFT_OUT, *EXTRACTED, "lost_spans_ns", "is_complete", "frame", "suspicions", "unused"}
    known |= {"accuracy", "taken", "measurements", "height"}
    flat = dict(flatten(summary))
    found = [(text(words), text(flat[key])) for key, words in EXTRACTED.items() if flat.get(key)]
    # What else was counted is told where there was any.
    others = [(label(key), text(value)) for key, value in flat.items() if value and not {key, key.split(".")[0]} & known]
    return found + others[:MAX_ENTRIES] + rows


def _verdict(health: Health) -> str:
    if health.is_complete:
        return "<p>The log is complete: nothing that its recorder wrote is missing.</p>"
    return '<p class="problem">The log is not complete: messages are lost, or may be. What could be read was used.</p>'


def _problems(health: Health) -> str:
    problems = health.problems
    items = "".join(f"<li>{text(problem)}</li>" for problem in problems[:MAX_ENTRIES])
    rest = f"<li>and {len(problems) - MAX_ENTRIES} more</li>" if len(problems) > MAX_ENTRIES else ""
    return f"<h3>Problems</h3><ul>{items}{rest}</ul>" if items else ""


def _lost_spans(mission: Mission, health: Health) -> str:
    clock = Clock(mission.start_ns, mission.end_ns)
    rows = [
        [
            text(clock.moment(first, 3)),
            text(clock.moment(last, 3)),
            text(duration(max(last - first, 0) / 1e9)),
        ]
        for first, last in health.lost_spans_ns[:MAX_ENTRIES]
    ]
    return f"<h3>Lost spans (log time)</h3>{table(['from', 'to', 'length'], rows)}" if rows else ""


def _channels(mission: Mission) -> str:
    channels = mission.catalogue.channels
    if not channels:
        return ""
    rows = [
        [text("–" if value is None else three_digits(value) if isinstance(value, float) else value) for value in values]
        for values in ([getattr(channel, key) for key in CHANNEL] for channel in channels[:MAX_CHANNELS])
    ]
    rest = (
        f'<p class="note">{len(channels) - MAX_CHANNELS} more channels are in catalogue.json.</p>'
        if len(channels) > MAX_CHANNELS
        else ""
    )
    numeric = [list(CHANNEL).index(key) for key in ("num_messages", "mean_rate_hz")]
    body = table(list(CHANNEL.values()), rows, numeric)
    return f"<details><summary>{len(channels)} channel{'s' if len(channels) > 1 else ''}</summary>{body}{rest}</details>"
