"""What is wrong with a log, what can be used of it, and what to do: `cadence doctor`, in plain words."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from cadence.errors import CadenceError, ImplausibleInputError, InputError, PartialInputError, UsageError
from pipeline.counted import counted, told
from pipeline.extract.config import ExtractConfig
from pipeline.extract.writing import write_tables
from pipeline.ingest.writing import survey_channels
from pipeline.inspect.log_times import time_remarks
from pipeline.logs.container import container_remarks
from pipeline.logs.health import utc
from pipeline.logs.reader import MissionLog, open_parts
from pipeline.measurement_words import measurement_words
from pipeline.missions import find_missions
from pipeline.place_words import place_words
from pipeline.progress import Progress
from pipeline.stores.urls import is_url
from pipeline.suspicions import few, suspicions_in

Verdict = Literal["sound", "faulty", "partial", "unusable"]
_MEANING: Mapping[Verdict, str] = {
    "sound": "SOUND",
    "faulty": "ALL MESSAGES CAN BE READ, but the file is damaged",
    "partial": "PARTIAL: messages are lost, or may be",
    "unusable": "UNUSABLE",
}
_LEFT_OUT = {
    "undecodable": "messages cannot be decoded",
    "incomplete": "messages have no position where it is looked for",
    "no_fix": "positions are marked as having no fix, or as not valid",
    "dropped_nonfinite": "positions are NaN, infinite or off the earth",
    "spikes": "positions lie far off their track",
    "other_frame": "positions are in another frame that no transform joins",
    "ground_heights": "altitudes are 0 where a track begins or ends, as on the ground",
    "static": "returns stand, by the Doppler of their scans",
    "bad_covariance": "covariances are not positive definite",
}
_ADVICE = {
    "copy": "If there is another copy of the recording, use that one: what is lost here may be whole there.",
    "as it is": "`cadence run` works on the damaged log as it is: it takes what is sound, and lost spans are gaps.",
    "nothing": "Say which channel holds detections: `cadence info LOG` prints the lines for a file of settings.",
    "joined": "Keep each recording as a file of its own: most tools find only one of those that were joined to one file.",
    "recorder": "Let the recorder write checksums and an index (most do unless told otherwise), and end it in good order.",
    "again": "Every message is there: copy the file again if it was copied, else let its recorder end it in good order.",
    "clock": "Check the recorder's clock; a source with time = \"publish_time\" or a stamp's path uses another one.",
    "suspicion": "Look at what is suspected, and state the setting that it names: then it is as you say.",
    "schema": "Channels that cannot be decoded are left out; to use one, record it with its schema in a known encoding.",
}


@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` found in one log; times are log times, sentences are for people.

    verdict      sound; faulty: every message can be read, though the file is damaged; partial: messages are lost or may be;
                 unusable: no message can be read
    num_messages_expected  None where nothing in the file says so
    lost_spans_ns          first and last log time of stretches in which messages are lost, as far as they are known
    problems     damage, by the walk over the file
    container    what the file lacks without loss: index, statistics, checksums, order of its chunks
    clocks, gaps what is odd about the times; when nothing was recorded
    undecodable  channels that cannot be decoded, and why
    suspicions   what a log says and can hardly mean, what was made of it, and how to decide otherwise
    use          what `cadence run` would take from the log without any settings
    no_use       why it would take nothing; empty where it would
    advice       what to do
    """

    log: str
    verdict: Verdict
    num_messages: int = 0
    num_messages_expected: int | None = None
    start_ns: int = 0
    end_ns: int = 0
    lost_spans_ns: tuple[tuple[int, int], ...] = ()
    problems: tuple[str, ...] = ()
    container: tuple[str, ...] = ()
    clocks: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()
    undecodable: tuple[str, ...] = ()
    suspicions: tuple[str, ...] = ()
    use: Mapping[str, Any] = field(default_factory=dict)
    no_use: str = ""
    advice: tuple[str, ...] = ()


def diagnose_all(logs: Sequence[str], progress: Progress) -> tuple[Diagnosis, ...]:
    """The diagnoses of files, folders and patterns of them; the parts of a split recording are one log.

    `UsageError` for URLs, `InputError` where a folder or a pattern holds no log.
    """
    if any(is_url(log) for log in logs):
        raise UsageError("cadence doctor reads local files; copy the log here, or let `cadence run` fetch it")
    return tuple(diagnose([Path(part) for part in mission.parts], progress) for mission in find_missions(logs, ""))


def diagnose(parts: Sequence[Path], progress: Progress) -> Diagnosis:
    """The diagnosis of a log, which may lie in several files. Nothing that is in them makes it raise."""
    name = str(parts[0]) if len(parts) == 1 else f"{parts[0]} and {len(parts) - 1} more parts"
    try:
        size = sum(part.stat().st_size for part in parts if part.is_file())
        with progress.bar(size, f"check {parts[0].name}", unit="B", scale=True) as bar:
            log = open_parts(parts, bar.update)
        if not log.health.num_messages and not log.health.is_complete:
            return Diagnosis(name, "unusable", problems=log.health.problems, advice=(_ADVICE["copy"],))
        return _of(name, log)
    except InputError as error:  # which says itself what to do
        return Diagnosis(name, "unusable", problems=(str(error),))


def exit_code(diagnoses: Sequence[Diagnosis]) -> int:
    """0 where every message of every log can be read and meant; an unusable log counts most, then suspicion, then loss."""
    verdicts = {diagnosis.verdict for diagnosis in diagnoses}
    if "unusable" in verdicts:
        return InputError.exit_code
    if any(diagnosis.suspicions for diagnosis in diagnoses):
        return ImplausibleInputError.exit_code
    return PartialInputError.exit_code if "partial" in verdicts else 0


def render(diagnosis: Diagnosis) -> str:
    """The diagnosis as text."""
    doubt = (
        f"; DOUBTFUL: {counted(len(diagnosis.suspicions), 'thing')} in it can hardly be meant" if diagnosis.suspicions else ""
    )
    lines = [f"{diagnosis.log}: {_MEANING[diagnosis.verdict]}{doubt}"]
    if diagnosis.verdict != "unusable" and not diagnosis.num_messages:
        lines.append("  no message was recorded")
    elif diagnosis.num_messages:
        of = "" if diagnosis.num_messages_expected is None else f" of {diagnosis.num_messages_expected}"
        span = f"{utc(diagnosis.start_ns)} to {utc(diagnosis.end_ns)}"
        lines.append(f"  {diagnosis.num_messages}{of} messages can be read, {span}")
    titles = {
        "problems": "What is wrong", "container": "Container", "clocks": "Clocks", "gaps": "Gaps",
        "undecodable": "Channels that cannot be decoded", "suspicions": "What is suspected",
    }  # fmt: skip
    for name, title in titles.items():
        if getattr(diagnosis, name):
            lines += [f"{title}:", *(f"  {sentence}" for sentence in few(getattr(diagnosis, name)))]
    if diagnosis.use or diagnosis.no_use:
        lines += ["What `cadence run` would use:", *(f"  {line}" for line in _use_lines(diagnosis))]
    if diagnosis.advice:
        lines += ["What to do:", *(f"  {sentence}" for sentence in diagnosis.advice)]
    return "\n".join(lines)


def _of(name: str, log: MissionLog) -> Diagnosis:
    """The diagnosis of a log with messages."""
    health, times = log.health, time_remarks(log)
    container = [remark for part in log.parts for remark in container_remarks(part)]
    if not health.has_checksums:
        container.append("Some chunks have no checksum: changed bytes inside messages could not be noticed.")
    undecodable = tuple(channel.reason for channel in survey_channels(log) if channel.reason)
    use, no_use = use_of(log)
    suspicions = tuple(suspicions_in(use))
    verdict: Verdict = "partial" if not health.is_complete else "faulty" if health.problems else "sound"
    is_joined = log.num_recordings > len(log.parts)
    reasons = {
        "copy": not health.is_complete,
        "as it is": not health.is_complete and not no_use,
        "nothing": bool(no_use),
        "joined": is_joined,
        "recorder": bool(container),
        "again": bool(health.problems and health.is_complete and not is_joined),
        "clock": bool(times.clocks),
        "schema": bool(undecodable),
        "suspicion": bool(suspicions),
    }
    return Diagnosis(
        name, verdict, health.num_messages, health.num_messages_expected, log.start_ns, log.end_ns, health.lost_spans_ns,
        health.problems, tuple(container), times.clocks, times.gaps, undecodable, suspicions, use, no_use,
        tuple(_ADVICE[name] for name, applies in reasons.items() if applies),
    )  # fmt: skip


def use_of(log: MissionLog) -> tuple[Mapping[str, Any], str]:
    """What the stage extract makes of the log by default, and why it makes nothing."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return write_tables(log, Path(folder), ExtractConfig(), Progress(quiet=True)), ""
        except CadenceError as error:
            return {}, str(error).removeprefix(f"{log.path}: ")


def _use_lines(diagnosis: Diagnosis) -> list[str]:
    if diagnosis.no_use:
        return [f"nothing: {diagnosis.no_use}"]
    use = diagnosis.use
    agents = counted(use["num_agents"], "agent") if use["num_agents"] else "agents that are not named"
    place = place_words(use["frame"]["latitude_deg"], use["frame"]["longitude_deg"])
    around = f", around {place}" if place else ""
    counts = [f"{counted(use['num_detections'], 'detection')} of {agents}{_topics(use, 'detections')}{around}"]
    if use["num_unknown_origin"] and use["num_agents"]:
        counts.append(
            counted(
                use["num_unknown_origin"],
                "of them does not say which agent it is of",
                "of them do not say which agent they are of",
            )
        )
    for role, name, whose in (("truth", "num_truth", "the truth"), ("poses", "num_poses", "sensors")):
        if use[name]:
            counts.append(f"{counted(use[name], 'position')} of {whose}{_topics(use, role)}")
    if words := measurement_words(use.get("measurements", {})):
        counts.append(words)
    counts += [f"left out: {told(use[name], words)}" for name, words in _LEFT_OUT.items() if use.get(name)]
    return counts + [f"not used, though it may hold detections: {channel}: {why}" for channel, why in use["unused"].items()]


def _topics(use: Mapping[str, Any], role: str) -> str:
    topics = use["sources"][role]
    return f" from {', '.join(topics[:4])}{' and others' if len(topics) > 4 else ''}" if topics else ""
