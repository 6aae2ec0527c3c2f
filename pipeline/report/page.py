"""The page itself: sections in the order in which they are read, style and script inline, one file."""

import base64
import hashlib
from collections.abc import Sequence
from html import escape
from importlib import resources
from string import Template

from pipeline.clock import Clock, duration
from pipeline.counted import counted
from pipeline.place_words import place_words
from pipeline.report.analysis import Analysis, Moment, share_of_steps
from pipeline.report.answers import answers_section
from pipeline.report.health import health_section
from pipeline.report.heights import height_section
from pipeline.report.markup import inline_json, legend, pairs, section, text
from pipeline.report.mission import Mission
from pipeline.report.origins import origins_section
from pipeline.report.payload import Payload
from pipeline.report.provenance import provenance_section
from pipeline.report.sections import moments_section, trouble_section, uncertainty_section
from pipeline.report.silence import silence_section
from pipeline.report.suspicions import suspicions_section
from pipeline.report.truth import truth_section
from pipeline.report.verdict import verdict_section
from pipeline.stream_words import stream_words
from pipeline.tracks import UNKNOWN_AGENT

READING = (
    "A hypothesis is one complete, plausible story of where every agent was between its detections and where it may go next; "
    "where the hypotheses fan out, the log does not say.",
    "Blue lines are the past up to the chosen moment, orange lines the future after it; filled dots are detections up to that "
    "moment, fading with age, and hollow dots are later ones, which were not used.",
    "The thick line is the mean. Where hypotheses part into several ways, a mean would lie where nobody is: there, each way is "
    "drawn as one of its hypotheses, with its share and on which side it lies (47 % east).",
)

WORDS = (
    ("agent", "who or what was detected and is tracked: a ship, an aircraft, a person"),
    ("detection", "one statement of a sensor that an agent was at a place at a time"),
    ("window", "a stretch of time around a moment, for which hypotheses are drawn together; only detections up to it are used"),
    ("weight", "the share of belief in a hypothesis; those of a window add up to one, and heavier lines are drawn stronger"),
    ("track", "the line of one agent in one hypothesis of one window"),
    ("bands", "at every step, where 50 % and 90 % of the weight lie"),
    ("spread", "how far hypotheses are from their middle: the root mean square of their distances"),
    ("truth", "where an agent really was, as the log recorded it; it is compared with, never used"),
    ("there: 62 %", "how likely it is that an agent exists, where the log does not say who was seen"),
)

PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="$policy">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title – hypothesis tracks</title>
<style>
$style</style>
</head>
<body>
<main>
$sections</main>
<script type="application/json" id="data">$data</script>
<script>$script</script>
</body>
</html>
""")


def write_page(mission: Mission, analysis: Analysis, payload: Payload, moments: Sequence[Moment], whole: str = "") -> str:
    """The page as text; `whole` is the section with the map of the whole mission."""
    script = _asset("moving.js") + _asset("page.js")
    # Only our own script may run and nothing may be fetched, whatever a log manages to put into the page.
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    presence = {name: mission.presence(agent) for agent, name in enumerate(mission.agents)}
    sections = (
        _header(mission),
        verdict_section(mission, analysis, payload.num_parted),
        _figures(mission),
        suspicions_section(mission),
        whole,
        answers_section(mission, mission.answers, mission.events),
        _reading(mission),
        _explorer(mission, payload),
        moments_section(mission, analysis, moments),
        origins_section(mission.origins, mission.start_ns, mission.end_ns, presence, mission.num_tracked, _stream(mission)),
        silence_section(mission),
        uncertainty_section(mission, analysis),
        height_section(mission),
        truth_section(mission, analysis),
        trouble_section(mission),
        health_section(mission),
        provenance_section(mission),
    )
    return PAGE.substitute(
        policy=policy, title=text(mission.name), style=_asset("page.css"), sections="".join(sections),
        data=inline_json(payload.content), script=script,
    )  # fmt: skip


def _asset(name: str) -> str:
    return resources.files("pipeline.report").joinpath(name).read_text(encoding="utf-8")


def _header(mission: Mission) -> str:
    clock = Clock(mission.log_start_ns, mission.log_end_ns)
    length = duration((mission.log_end_ns - mission.log_start_ns) / 1e9)
    words = ["Hypothesis tracks from sparse detections", clock.range(), length]
    place = place_words(mission.frame.latitude_deg, mission.frame.longitude_deg)
    words += [f"zero of its metres at {place}"] if place else []
    line = text(" · ".join(words))
    return f"<header><h1>{text(mission.name)}</h1><p>{line}</p>{_thinned(mission)}</header>\n"


def _stream(mission: Mission) -> str:
    """What a stream without identity turned out to be, in words."""
    summary = mission.manifests.get("infer", {}).get("summary") or {}
    return stream_words(summary.get("association") or {})


def _figures(mission: Mission) -> str:
    cells = "".join(
        f"<div><dt>{text(name)}</dt><dd>{text(value)}<small>{text(extra)}</small></dd></div>"
        for name, value, extra in _facts(mission)
    )
    return f'<dl class="facts">{cells}</dl>\n'


def _thinned(mission: Mission) -> str:
    """A run whose detections were made sparse on purpose is no picture of what was recorded."""
    thinning = ((mission.manifests.get("extract", {}).get("config") or {}).get("thinning")) or {}
    if not thinning.get("enabled"):
        return ""
    gap_s, burst_s = (duration(float(thinning.get(name) or 0)) for name in ("mean_gap_s", "mean_burst_s"))
    source = "truth" if thinning.get("thin_from") == "truth" else "own detections"
    words = (
        f"Thinned on purpose (extract.thinning): the {len(mission.detections):,} detections were taken out of the log’s "
        f"{source}, in bursts of about {burst_s} between gaps of about {gap_s}. The log itself holds more."
    )
    return f'<p class="problem">{text(words)}</p>'


def _facts(mission: Mission) -> list[tuple[str, str, str]]:
    share = share_of_steps(mission)
    is_unknown = mission.detections.owner < 0
    if UNKNOWN_AGENT in mission.agents:
        is_unknown |= mission.detections.owner == mission.agents.index(UNKNOWN_AGENT)
    unknown = int(is_unknown.sum()) if mission.origins is None else mission.origins.num_detections
    num_seen = len({row.agent for row in mission.rows})
    # Agents that were found have other names than those of the truth, and may be the same.
    only_true = "more only in the truth" if mission.origins is None else "named by the truth"
    others = {only_true: len(mission.agents) - num_seen, "more without hypotheses": num_seen - mission.num_tracked}
    more = ", ".join(f"{count:,} {words}" for words, count in others.items() if count)
    facts = [
        ("Agents", f"{mission.num_tracked:,}", more),
        ("Detections", f"{len(mission.detections):,}", f"{unknown:,} without a known agent" if unknown else ""),
    ]
    if not mission.fans:
        return [*facts, ("Windows", f"{len(mission.origins_ns):,}", ""), ("Hypotheses", "0", "")]
    fan = mission.fans[0]
    step_s = fan.step_ns / 1e9
    ahead_s = (fan.offset_m.shape[1] - 1 - fan.origin_index) * step_s
    counts = [len(fan.weight) for fan in mission.fans]
    return [
        *facts,
        (
            "Steps with a detection",
            "–" if share is None else f"{100 * share:.3g} %",
            f"a step is {duration(step_s)}; while an agent was tracked",
        ),
        ("Windows", f"{len(mission.origins_ns):,}", f"{duration(fan.origin_index * step_s)} back, {duration(ahead_s)} ahead"),
        ("Hypotheses a window", f"{max(counts):,}", f"{sum(counts):,} tracks in all"),
    ]


def _reading(mission: Mission) -> str:
    keys = [
        ('<polyline class="past" points="0,6 26,6"/><polyline class="past mean" points="0,10 26,10"/>', "past, and its mean"),
        ('<polyline class="future" points="0,6 26,6"/><polyline class="future mean" points="0,10 26,10"/>', "future and mean"),
        ('<circle class="detection" cx="5" cy="8" r="4"/>', "detection, new"),
        ('<circle class="detection" cx="5" cy="8" r="4" fill-opacity=".35"/>', "old"),
        ('<circle class="later" cx="5" cy="8" r="4"/>', "later, not used"),
        ('<circle class="now" cx="8" cy="8" r="6"/>', "at the moment: the mean, or each way"),
    ]
    keys += [('<polyline class="truth" points="0,8 26,8"/>', "truth")] if mission.truth is not None else []
    keys += [('<rect class="obstacle" x="3" y="2" width="20" height="12"/>', "obstacle")] if mission.obstacles else []
    keys += [('<path class="sensor" d="M13 2 L19 13 L7 13 Z"/>', "sensor")] if mission.poses is not None else []
    words = pairs((text(word), text(meaning)) for word, meaning in WORDS)
    content = f"<p>{escape(' '.join(READING))}</p>{legend(keys)}<details><summary>Words</summary>{words}</details>"
    return section("How to read this page", content, kind="read")


def _explorer(mission: Mission, payload: Payload) -> str:
    layers = [("past", "Past"), ("future", "Future"), ("mean", "Mean, ways"), ("envelopes", "50 / 90 % bands")]
    layers += [("detections", "Detections"), ("everywhere", "All detections")]
    layers += [("names", "Names")] if len(mission.agents) > 1 else []
    layers += [("truth", "Truth")] if mission.truth is not None else []
    layers += [("obstacles", "Obstacles")] if mission.obstacles else []
    layers += [("sensors", "Sensors")] if mission.poses is not None else []
    boxes = "".join(f'<label><input type="checkbox" data-layer="{name}" checked> {words}</label>' for name, words in layers)
    note = f"To keep this file small, the map shows {'; '.join(payload.notes)}." if payload.notes else ""
    skipped = len(mission.origins_ns) - len(mission.drawn_windows)
    note += f" {skipped:,} windows without any hypotheses are skipped." if skipped else ""
    columns = "± spread, time since it was last seen"
    if mission.has_presence:
        columns = f"how likely it is there, {columns}"
    if payload.content["unlikely"]:
        never = "that {} never even 50 % likely {}"
        agents = (f"agent {never.format('is', 'is')}", f"agents {never.format('are', 'are')}")
        columns += f"; {counted(len(payload.content['unlikely']), *agents)} not ticked"
    content = Template(_asset("explorer.html")).substitute(layers=boxes, columns=columns)
    # Without scripts the section is hidden, and the drawings below stand for it.
    return section("Map", content, note, kind="only-script")
