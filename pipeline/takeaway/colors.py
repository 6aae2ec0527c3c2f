"""A colour for each agent: hues as far apart as there are agents."""

import colorsys
from collections.abc import Sequence

_GOLDEN = 0.6180339887498949
_FIRST = 0.58


def colors(agent_ids: Sequence[str]) -> dict[str, tuple[int, int, int]]:
    """Red, green and blue from 0 to 255, by agent."""
    found = {}
    for number, agent_id in enumerate(agent_ids):
        parts = colorsys.hsv_to_rgb((_FIRST + number * _GOLDEN) % 1.0, 0.75, 0.85)
        found[agent_id] = (round(255 * parts[0]), round(255 * parts[1]), round(255 * parts[2]))
    return found


def opacity(weight: float, heaviest: float) -> float:
    """That of a line: by its weight beside the heaviest."""
    return 0.15 + 0.55 * weight / heaviest if heaviest > 0 else 0.15
