"""The page itself: sections in the order in which they are read, style and script inline, one file."""

import base64
import hashlib
import shlex
from collections.abc import Sequence
from html import escape
from importlib import resources

import numpy as np

from pipeline.report.analysis import Analysis, Moment, TruthScore, find_troubles, shape_of, share_of_steps
from pipeline.report.clock import Clock, duration
from pipeline.report.figures import SpreadAxis, TimeAxis, metres, moment_map, uncertainty_chart
from pipeline.report.health import health_section
from pipeline.report.markup import as_toml, flatten, inline_json, label, pairs, section, table, text
from pipeline.report.mission import Mission
from pipeline.report.payload import Payload

MAX_TROUBLES = 100
OPEN_CHART_ROWS, MAX_CHART_ROWS = 8, 60


def write_page(mission: Mission, analysis: Analysis, payload: Payload, moments: Sequence[Moment]) -> str:
    """The whole page as text."""
    style = resources.files("pipeline.report").joinpath("page.css").read_text(encoding="utf-8")
    script = resources.files("pipeline.report").joinpath("page.js").read_text(encoding="utf-8")
    # Only our own script may run and nothing may be fetched, whatever a log manages to put into the page.
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    sections = [
        _header(mission),
        _reading(mission),
        _explorer(mission, payload),
        _moments(mission, analysis, moments),
        _uncertainty(mission, analysis),
        _truth(mission, analysis),
        _troubles(mission),
        health_section(mission),
        _provenance(mission),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(mission.name)} – hypothesis tracks</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n"
        f"{''.join(sections)}</main>\n"
        f'<script type="application/json" id="data">{inline_json(payload.content)}</script>\n'
        f"<script>{script}</script>\n</body>\n</html>\n"
    )


def _header(mission: Mission) -> str:
    clock = Clock(mission.start_ns, mission.end_ns)
    share = share_of_steps(mission)
    step_ns = mission.fans[0].step_ns if mission.fans else 0
    counts = [len(fan.weight) for fan in mission.fans]
    horizon = ""
    if mission.fans:
        fan = mission.fans[0]
        last = fan.offset_m.shape[1] - 1 - fan.origin_index
        horizon = f"{duration(fan.origin_index * step_ns / 1e9)} back, {duration(last * step_ns / 1e9)} ahead"
    facts = [
        ("Agents", f"{len(mission.agents):,}", ""),
        ("Detections", f"{len(mission.detections):,}", _unknown_origin(mission)),
        ("Steps with a detection", "–" if share is None else f"{100 * share:.3g} %", f"steps of {duration(step_ns / 1e9)}" if step_ns else ""),
        ("Windows", f"{len(mission.origins_ns):,}", horizon),
        ("Hypotheses a window", f"{max(counts):,}" if counts else "0", f"{sum(counts):,} tracks drawn in all" if counts else ""),
    ]
    cells = "".join(f"<div><dt>{name}</dt><dd>{value}<small>{text(extra)}</small></dd></div>" for name, value, extra in facts)
    where = ""
    if mission.frame.is_georeferenced:
        where = f" · datum {mission.frame.latitude_deg:.5f}°, {mission.frame.longitude_deg:.5f}°"
    return (
        f"<header><h1>{text(mission.name)}</h1>"
        f"<p>Hypothesis tracks from sparse detections · {text(clock.range())} · {duration((mission.end_ns - mission.start_ns) / 1e9)}{where}</p>"
        f'<dl class="facts">{cells}</dl></header>\n'
    )


def _unknown_origin(mission: Mission) -> str:
    unknown = int((mission.detections.owner < 0).sum())
    return f"{unknown:,} without a known agent" if unknown else ""


def _reading(mission: Mission) -> str:
    sentences = (
        "A hypothesis is one complete, plausible story of where every agent was between its detections and where it may go next; "
        "where the hypotheses fan out, the log does not say. "
        "Blue lines are the past up to the chosen moment (the window’s origin), orange lines the future after it; filled dots are the "
        "detections that were used, fading with age, and hollow dots are later ones that were not. "
        "Each hypothesis has a weight, its share of the belief: the weights of a window add up to one, heavier lines are drawn "
        "stronger, and the shaded bands hold 50 % and 90 % of the weight at every step."
    )
    keys = [
        ('<polyline class="past" points="0,6 26,6"/><polyline class="past mean" points="0,10 26,10"/>', "past, and its mean"),
        ('<polyline class="future" points="0,6 26,6"/><polyline class="future mean" points="0,10 26,10"/>', "future, and its mean"),
        ('<circle class="detection" cx="5" cy="8" r="4"/><circle class="detection" cx="16" cy="8" r="4" fill-opacity=".35"/>', "detection: new, old"),
        ('<circle class="later" cx="13" cy="8" r="4"/>', "later detection, not used"),
        ('<circle class="now" cx="13" cy="8" r="6"/>', "mean at the origin"),
    ]
    if mission.truth is not None:
        keys.append(('<polyline class="truth" points="0,8 26,8"/>', "truth"))
    if mission.obstacles:
        keys.append(('<rect class="obstacle" x="3" y="2" width="20" height="12"/>', "obstacle"))
    if mission.poses is not None:
        keys.append(('<path d="M13 2 L19 13 L7 13 Z" fill="var(--sensor)"/>', "sensor"))
    items = "".join(f'<li><svg width="26" height="16" style="display:inline-block">{drawing}</svg>{words}</li>' for drawing, words in keys)
    return section("How to read this page", f'<p>{escape(sentences)}</p><ul class="legend">{items}</ul>', kind="read")


def _explorer(mission: Mission, payload: Payload) -> str:
    layers = [("past", "Past", True), ("future", "Future", True), ("mean", "Mean", True), ("envelopes", "50 / 90 % bands", True),
              ("detections", "Detections", True), ("names", "Names", len(mission.agents) > 1)]  # fmt: skip
    layers += [("truth", "Truth", True)] if mission.truth is not None else []
    layers += [("obstacles", "Obstacles", True)] if mission.obstacles else []
    layers += [("sensors", "Sensors", True)] if mission.poses is not None else []
    boxes = "".join(
        f'<label><input type="checkbox" data-layer="{name}"{" checked" if is_on else ""}> {words}</label>' for name, words, is_on in layers
    )
    note = f"Shown on this map: {'; '.join(payload.notes)}." if payload.notes else ""
    content = f"""
<div class="explore">
<div class="canvas"><canvas id="map" tabindex="0" role="img" aria-label="Map of hypotheses and detections. Arrow keys move it, plus and minus zoom, 0 shows everything, comma and full stop change the window, space plays."></canvas>
<div class="zoom"><button type="button" id="zoom-in" aria-label="zoom in">+</button><button type="button" id="zoom-out" aria-label="zoom out">−</button><button type="button" id="fit-window">This window</button><button type="button" id="fit-all">Whole mission</button></div>
<div id="readout"></div></div>
<div class="panel"><fieldset><legend>Layers</legend><div class="layers">{boxes}</div></fieldset>
<fieldset class="agents"><legend>Agents (spread and age at the origin)</legend><div><button type="button" id="all">all</button> <button type="button" id="none">none</button></div><ul id="agents"></ul></fieldset></div>
</div>
<div class="timeline"><button type="button" id="play">Play</button><select id="pace" aria-label="pace"><option value="900">slow</option><option value="450" selected>normal</option><option value="180">fast</option></select>
<button type="button" id="previous" aria-label="previous window">‹</button><input type="range" id="window" min="0" max="0" step="1" value="0" aria-label="window"><button type="button" id="next" aria-label="next window">›</button><output id="moment" for="window"></output></div>
<p class="note">Drag to move, wheel to zoom, click an agent’s name to go to it, click a chart below to go to that time. {text(note)}</p>
"""
    # Without scripts the section is hidden and the drawings below stand for it.
    return section("Map", content, kind="only-script", identity="explorer")


def _moments(mission: Mission, analysis: Analysis, moments: Sequence[Moment]) -> str:
    if not moments:
        return section("Chosen moments", "<p>No window has hypotheses; the windows are listed below with the reasons.</p>")
    clock = Clock(mission.start_ns, mission.end_ns)
    ages = {(row.window, row.agent): row.age_s for row in mission.rows}
    figures = []
    for moment in moments:
        fan = mission.fans[moment.fan]
        age = ages.get((fan.window, fan.agent))
        words = [f"{mission.agents[fan.agent]} at {clock.moment(fan.origin_ns)}: spread {metres(analysis.spread_now_m[moment.fan])}"]
        words += [f"last seen {duration(age)} before"] if age is not None else []
        if np.isfinite(analysis.error_now_m[moment.fan]):
            words.append(f"mean {metres(analysis.error_now_m[moment.fan])} from truth")
        caption = ", ".join(words)
        seconds = (fan.origin_ns - mission.start_ns) / 1e9
        figures.append(
            f"<figure>{moment_map(mission, fan, shape_of(fan), f'{moment.reason}. {caption}')}"
            f"<figcaption><strong>{text(moment.reason)}.</strong> {text(caption)}. "
            f'<button type="button" class="only-script" data-seconds="{seconds:.3f}" data-agent="{fan.agent}">On the map</button>'
            "</figcaption></figure>"
        )
    lead = "The windows that deserve a look, one agent each; north is up, scales differ."
    return section("Chosen moments", f'<div class="moments">{"".join(figures)}</div>', lead)


def _uncertainty(mission: Mission, analysis: Analysis) -> str:
    if not mission.fans:
        return ""
    agents, widest = _ranked_agents(mission, analysis)
    axis, spread = TimeAxis(mission), SpreadAxis(analysis)
    content = uncertainty_chart(mission, analysis, agents[:OPEN_CHART_ROWS], axis, spread)
    rest = agents[OPEN_CHART_ROWS:MAX_CHART_ROWS]
    if rest:
        content += f"<details><summary>{len(rest)} more agents</summary>{uncertainty_chart(mission, analysis, rest, axis, spread)}</details>"
    if len(agents) > MAX_CHART_ROWS:
        content += f'<p class="note">{len(agents) - MAX_CHART_ROWS} more agents with a smaller spread are not drawn.</p>'
    keys = (
        ('<polyline class="past mean" points="0,8 26,8"/>', "spread at the origin"),
        ('<polyline class="future mean" points="0,8 26,8" style="stroke-dasharray:none"/>', "spread at the end of the horizon"),
        ('<path d="M13 3v10" style="stroke:var(--detection)"/>', "detection"),
        ('<path d="M10 5l6 6m0-6l-6 6" style="stroke:var(--text)"/>', "no hypotheses in this window"),
    )
    items = "".join(f'<li><svg width="26" height="16" style="display:inline-block">{drawing}</svg>{words}</li>' for drawing, words in keys)
    lead = "Spread is the root mean square distance of the hypotheses from their mean, on a logarithmic scale that all agents share."
    lead += f" Agents are sorted by it: {mission.agents[agents[0]]} has the largest median, {metres(widest)}." if len(agents) > 1 else ""
    return section("Uncertainty over time", content + f'<ul class="legend">{items}</ul>', lead)


def _ranked_agents(mission: Mission, analysis: Analysis) -> tuple[list[int], float]:
    """Agents with hypotheses by falling median spread at the origin, and the largest of these medians."""
    owner = np.array([fan.agent for fan in mission.fans])
    medians = {int(agent): float(np.median(analysis.spread_now_m[owner == agent])) for agent in np.unique(owner)}
    ranked = sorted(medians, key=lambda agent: (-medians[agent], agent))
    return ranked, medians[ranked[0]]


def _truth(mission: Mission, analysis: Analysis) -> str:
    if mission.truth is None and mission.scores is None:
        return ""

    def row(name: str, score: TruthScore) -> list[str]:
        return [name, f"{score.num_steps:,}", metres(score.mean_error_m), metres(score.median_error_m), f"{100 * score.coverage:.0f} %"]

    rows = [row(name, score) for name, score in (("past, origin included", analysis.past), ("future", analysis.future)) if score is not None]
    heads = ["steps", "compared", "mean error of the mean", "median error of the mean", "truth inside the 90 % band"]
    content = table(heads, rows, numeric=(1, 2, 3, 4)) if rows else "<p>Truth covers no step of any window.</p>"
    if mission.scores is not None:
        inner = pairs((label(key), text(value)) for key, value in flatten(mission.scores)[:200])
        content += f"<details><summary>Scores of cadence evaluate</summary>{inner}</details>"
    lead = (
        "Quick figures from the truth that was kept aside: each window, agent and step counts once, neighbouring steps are not independent. "
        "A well-calibrated 90 % band holds truth about 90 % of the time. cadence evaluate gives scores with intervals and rivals."
    )
    return section("Against truth", content, lead)


def _troubles(mission: Mission) -> str:
    troubles = find_troubles(mission)
    if not troubles:
        return section("Windows that need attention", "<p>None: every window of every agent has status ok.</p>")
    clock = Clock(mission.start_ns, mission.end_ns)
    rows = []
    for trouble in troubles[:MAX_TROUBLES]:
        first, last = trouble.first, trouble.last
        is_run = trouble.count > 1
        when = clock.moment(first.origin_ns) + (f" to {clock.moment(last.origin_ns)}" if is_run else "")
        number = f"{first.window}" + (f" to {last.window}" if is_run else "")
        rows.append([text(mission.agents[trouble.agent]), text(number), text(when), label(trouble.status), text(trouble.advice)])
    content = table(["agent", "windows", "origin", "status", "what to do"], rows)
    if len(troubles) > MAX_TROUBLES:
        content += f'<p class="note">{len(troubles) - MAX_TROUBLES} more rows are in windows.parquet.</p>'
    bad = sum(trouble.count for trouble in troubles)
    return section("Windows that need attention", content, f"{bad:,} of {len(mission.rows):,} (a row is a run of windows of one agent).")


def _provenance(mission: Mission) -> str:
    configs = {stage: mission.manifests[stage]["config"] for stage in mission.manifests if stage != "evaluate"}
    source = str(mission.catalogue.get("path") or mission.name)
    toml = as_toml({stage: config for stage, config in configs.items() if isinstance(config, dict) and config})
    parts = [f"<h3>To repeat this run</h3><p>Save the settings as repeat.toml, then:</p><pre>cadence run {text(shlex.quote(source))} --out results --config repeat.toml</pre>"]
    parts.append(f"<details><summary>repeat.toml</summary><pre>{escape(toml)}</pre></details>")
    facts = [("log", text(source))]
    facts += [("SHA-256 of the log", f"<code>{text(mission.catalogue['sha256'])}</code>")] if "sha256" in mission.catalogue else []
    infer = mission.manifests.get("infer", {})
    for key, value in [*flatten(infer.get("config", {})), *flatten(infer.get("summary", {}))]:
        if any(word in key for word in ("seed", "checkpoint", "preset")):
            facts.append((label(key), f"<code>{text(value)}</code>"))
    frame = f"{mission.frame.frame_id}" + (f", datum {mission.frame.latitude_deg}, {mission.frame.longitude_deg}" if mission.frame.is_georeferenced else "")
    facts.append(("mission frame", text(frame)))
    parts.append(f"<h3>Source and model</h3>{pairs(facts)}")
    for stage, manifest in mission.manifests.items():
        rows = [(label(key), text(value)) for key, value in flatten(manifest.get("summary", {}))]
        hashes = [(text(name), f"<code>{text(value)}</code>") for kind in ("inputs", "outputs") for name, value in sorted(dict(manifest.get(kind, {})).items())]
        versions = ", ".join(f"{name} {version}" for name, version in sorted(dict(manifest.get("versions", {})).items()))
        inner = f"<p>Versions: {text(versions)}</p>{pairs(rows)}<h3>SHA-256 of inputs and outputs</h3>{pairs(hashes)}"
        parts.append(f"<details><summary>{text(stage)}</summary>{inner}</details>")
    return section("Settings and provenance", f"<details><summary>Show</summary>{''.join(parts)}</details>")
