"""Sections on the hypotheses: chosen moments, uncertainty over time, windows that need attention."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.clock import Clock, duration
from pipeline.lengths import metres
from pipeline.report.analysis import Analysis, Moment, Trouble, find_troubles, shown_share, shown_steps
from pipeline.report.charts import SpreadAxis, TimeAxis, uncertainty_chart
from pipeline.report.maps import moment_map
from pipeline.report.markup import label, legend, section, table, text
from pipeline.report.mission import Fan, Mission, WindowRow
from pipeline.report.modes import Strand, strands_of
from pipeline.report.scored import truth_of
from pipeline.report.shapes import shape_of

OPEN_ROWS, MAX_ROWS, MAX_RUNS = 10, 300, 4
OPEN_CHART_ROWS, MAX_CHART_ROWS = 8, 60


def moments_section(mission: Mission, analysis: Analysis, moments: Sequence[Moment]) -> str:
    """Small maps, readable without scripts and on paper."""
    if not mission.fans:
        return section("Chosen moments", "<p>No window has hypotheses; the reasons are listed below.</p>")
    if not moments:
        return ""
    clock = Clock(mission.start_ns, mission.end_ns)
    rows = {(row.window, row.agent): row for row in mission.rows}
    share = shown_share(mission)
    figures = []
    for moment in moments:
        fan = mission.fans[moment.fan]
        row, error_m = rows.get((fan.window, fan.agent)), analysis.error_now_m[moment.fan]
        age = None if row is None else row.age_s
        strands = strands_of(fan, shape_of(fan), mission.solid)
        words = [f"{mission.called(fan.agent, [row] if row else [])} at {clock.moment(fan.origin_ns)}"]
        words += [f"spread {metres(analysis.spread_now_m[moment.fan])}"]
        words += [f"last seen {duration(abs(round(age, 1)))} before"] if age is not None else []
        words += ["seen only once until then"] if row is not None and row.num_detections == 1 else []
        words += [f"a hypothesis is {metres(error_m)} from the truth"] if np.isfinite(error_m) else []
        if row is not None and row.num_effective is not None:
            words += [f"its {len(fan.weight)} hypotheses tell as much as {row.num_effective:.0f} equal ones"]
        words += _ways(strands, fan.origin_index)
        steps = _moment_steps(mission, fan, share)
        if share < 1:
            back, ahead = (duration(abs(step - fan.origin_index) * fan.step_ns / 1e9) for step in steps)
            words += [f"drawn {back} back and {ahead} ahead"]
        truth = truth_of(mission, analysis.scored, fan.window, fan.agent)
        drawing = moment_map(mission, fan, strands, truth, steps, f"{moment.reason}. {', '.join(words)}")
        place = f'data-seconds="{(fan.origin_ns - mission.start_ns) / 1e9:.3f}" data-agent="{fan.agent}"'
        figures.append(
            f"<figure>{drawing}<figcaption><strong>{text(moment.reason)}.</strong> {text(', '.join(words))}. "
            f'<button type="button" class="only-script" {place}>On the map</button>'
            "</figcaption></figure>"
        )
    lead = (
        "Moments that deserve a look, one agent each. North is up; scales differ. Where hypotheses part into several ways, "
        "each is drawn as one of its hypotheses, with its share."
    )
    lead += " Agents that are less than 50 % likely there are left out." if mission.has_presence else ""
    return section("Chosen moments", f'<div class="moments">{"".join(figures)}</div>', lead)


def _ways(strands: Sequence[Strand], now: int) -> list[str]:
    """In words: the ways at the moment, and those at the end."""
    found = []
    for when, step in (("now", now), ("at the end", strands[-1].last)):
        ways = [strand for strand in strands if strand.share < 1 and strand.first <= step <= strand.last]
        if len(ways) > 1 and strands[-1].last > now:
            found.append(f"{when} " + ", ".join(f"{100 * way.share:.0f} % {way.direction}" for way in ways))
    return found


def _moment_steps(mission: Mission, fan: Fan, share: float) -> tuple[int, int]:
    """The steps to draw: the share, and as far back as the last detection."""
    first, last = shown_steps(fan, share)
    time_ns = mission.detections.of(fan.agent).between(int(fan.time_ns[0]), fan.origin_ns).time_ns
    seen = int(np.searchsorted(fan.time_ns, time_ns[-1])) if len(time_ns) else first
    return max(0, min(first, seen - 2)), last


def uncertainty_section(mission: Mission, analysis: Analysis) -> str:
    """A chart row an agent; the widest first, most of them folded away where there are many."""
    if not mission.fans:
        return ""
    agents, widest_m = _ranked_agents(mission, analysis)
    axis, spread = TimeAxis(mission), SpreadAxis(analysis)
    content = uncertainty_chart(mission, analysis, agents[:OPEN_CHART_ROWS], axis, spread)
    rest = agents[OPEN_CHART_ROWS:MAX_CHART_ROWS]
    if rest:
        chart = uncertainty_chart(mission, analysis, rest, axis, spread)
        content += f"<details><summary>{len(rest)} more agents</summary>{chart}</details>"
    if len(agents) > MAX_CHART_ROWS:
        content += f'<p class="note">{len(agents) - MAX_CHART_ROWS} more agents with a smaller spread are not drawn.</p>'
    keys = (
        ('<polyline class="past mean" points="0,8 26,8"/>', "spread at the window’s moment"),
        ('<polyline class="future mean solid" points="0,8 26,8"/>', "spread at the end of its future"),
        ('<path class="tick" d="M13 3v10"/>', "detection"),
        ('<rect class="void" x="3" y="2" width="20" height="12"/>', "windows without hypotheses"),
    )
    lead = (
        "How far hypotheses are from their middle (root mean square), window after window, in powers of ten, on the same "
        "scale for all agents."
    )
    if len(agents) > 1:
        name = mission.called(agents[0], [row for row in mission.rows if row.agent == agents[0]])
        lead += f" Agents are sorted by their median spread; {name} has the largest, {metres(widest_m)}."
    return section("Uncertainty over time", content + legend(keys), lead)


def _ranked_agents(mission: Mission, analysis: Analysis) -> tuple[list[int], float]:
    """Agents with hypotheses by falling median spread at the origin, and the largest of these medians."""
    owner = np.array([fan.agent for fan in mission.fans])
    medians = {int(agent): float(np.median(analysis.spread_now_m[owner == agent])) for agent in np.unique(owner)}
    ranked = sorted(medians, key=lambda agent: (-medians[agent], agent))
    return ranked, medians[ranked[0]]


def trouble_section(mission: Mission) -> str:
    """Windows with a status other than ok: a table for each piece of advice, a row an agent."""
    troubles = find_troubles(mission)
    if not troubles:
        return section("Windows that need attention", "<p>None: every window of every agent is ok.</p>")
    kinds: dict[tuple[str, str], dict[int, list[Trouble]]] = {}
    for trouble in troubles:
        # Advice that differs only in its numbers is one piece of advice; the first stands for all.
        kind = (trouble.status, re.sub(r"[0-9][0-9.,]*", "0", trouble.advice))
        kinds.setdefault(kind, {}).setdefault(trouble.agent, []).append(trouble)
    content = "".join(_trouble_table(mission, runs) for runs in kinds.values())
    bad = sum(trouble.count for trouble in troubles)
    lead = f"{bad:,} of the {len(mission.rows):,} pairs of a window and an agent are not ok."
    return section("Windows that need attention", content, lead)


def _trouble_table(mission: Mission, runs: Mapping[int, Sequence[Trouble]]) -> str:
    first = next(iter(runs.values()))[0]
    clock = Clock(mission.start_ns, mission.end_ns)
    heads, rows = ["agent", "count", "windows", "their moments"], []
    for agent, found in sorted(runs.items()):
        words = [" to ".join(clock.moment(row.origin_ns) for row in _ends(trouble)) for trouble in found]
        spans = ", ".join(words[:MAX_RUNS]) + (f" and {len(words) - MAX_RUNS} more" if len(words) > MAX_RUNS else "")
        numbers = ", ".join(" to ".join(str(row.window) for row in _ends(trouble)) for trouble in found[:MAX_RUNS])
        numbers += ", …" if len(found) > MAX_RUNS else ""
        name = mission.called(agent, [row for trouble in found for row in _ends(trouble)])
        rows.append([text(name), str(sum(trouble.count for trouble in found)), text(numbers), text(spans)])
    body = table(heads, rows[:OPEN_ROWS], numeric=(1,))
    if len(rows) > OPEN_ROWS:
        rest = table(heads, rows[OPEN_ROWS:MAX_ROWS], numeric=(1,))
        body += f"<details><summary>{len(rows) - OPEN_ROWS} more agents</summary>{rest}</details>"
    return f"<h3>{label(first.status.capitalize())}</h3><p>{text(first.advice)}</p>{body}"


def _ends(trouble: Trouble) -> list[WindowRow]:
    return [trouble.first] if trouble.count == 1 else [trouble.first, trouble.last]
