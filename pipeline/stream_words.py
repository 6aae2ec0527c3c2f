"""What was found of a stream of detections without identity, in words."""

from collections.abc import Mapping
from typing import Any

from pipeline.counted import counted

_SURE = 0.5


def stream_words(record: Mapping[str, Any]) -> str:
    """A sentence of the `association` of `infer.manifest.json`; empty where it has no counts (an older one)."""
    counts = record.get("counts")
    if counts is None:
        return ""
    stated = record.get("stated", ())
    low, high, probability = counts["num_agents_low"], counts["num_agents_high"], counts["num_agents_probability"]
    if "num_agents" in stated:
        agents = counted(counts["num_agents"], "agent was", "agents were") + " detected (the number is stated)"
    elif probability < _SURE:
        agents = f"how many agents there are cannot be told ({low} to {high}; {counts['num_agents']} is the likeliest)"
    else:
        spread = "" if low == high else f", 95 %: {low} to {high}"
        agents = f"{counted(counts['num_agents'], 'agent')} (probability {probability:.2f}{spread})"
    told = f"{_percent(counts['clutter'])} of the detections are clutter"
    parts = [agents, told + (" (the share that was expected is stated)" if "clutter_share" in stated else "")]
    if counts["detection"] is not None:
        parts.append(f"an agent is detected in {_percent(counts['detection'])} of the scans")
    if counts["mean_gap_s"] is not None:
        parts.append(f"an agent is seen once in {counts['mean_gap_s']:.3g} s")
    return "detections without identity: " + ", ".join(parts)


def _percent(share: Mapping[str, float]) -> str:
    return f"{share['value']:.1%} ({share['low']:.1%} to {share['high']:.1%})"
