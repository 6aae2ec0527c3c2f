"""A colour for each agent, the same as in the side file and in the report."""

from collections.abc import Sequence

from pipeline.export.display import agent_hue


def colors(agent_ids: Sequence[str]) -> dict[str, tuple[int, int, int]]:
    """Red, green and blue from 0 to 255, by agent."""
    found = {}
    for number, agent_id in enumerate(agent_ids):
        red, green, blue = bytes.fromhex(agent_hue(number).removeprefix("#"))
        found[agent_id] = (red, green, blue)
    return found


def opacity(weight: float, heaviest: float) -> float:
    """That of a line: by its weight beside the heaviest."""
    return 0.15 + 0.55 * weight / heaviest if heaviest > 0 else 0.15
