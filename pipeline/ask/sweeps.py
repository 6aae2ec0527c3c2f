"""How much the sensors searched: the looks of a mission brought to the stories' clock, and their sweep in words."""

from collections.abc import Sequence
from typing import Any

from cadence.answers.estimates import Probability
from cadence.answers.sweeps import Sweep, swept
from cadence.errors import InputError
from cadence.evidence.exponents import SAFE
from cadence.evidence.silence import Silence
from pipeline.ask.known import Known
from pipeline.ask.words import numbers, percent, place_words
from pipeline.counted import counted
from pipeline.looks import Footprint, read_looks, silences
from pipeline.manifest import read_manifest
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacles

_NEARLY_ALL = 0.999


def sweep_words(known: Known, agent: int, span_s: tuple[float, float], during: str) -> tuple[str, Sweep, dict[str, Any]]:
    """What the sensors' looks would have found of an agent: in a sentence, as it is, and as plain values.

    Raises `InputError` where the mission tells of no looks within the time, or the agent is not there.
    """
    footprints, parts = _parts(known)
    name = known.stories.agent_ids[agent]
    try:
        found = swept(known.stories, agent, parts, span_s)
    except ValueError as error:
        raise InputError(f"{known.directory}: {name} is in no story {during}; ask about another time") from error
    if not found.num_looks:
        raise InputError(f"{known.directory}: no sensor looked {during}, {known.clock.range()}")
    looks = counted(found.num_looks, "look")
    words = [f"{looks} {during} did not see {name}, and would have with {_percent(found.success)}, as the stories have it"]
    told: dict[str, Any] = {
        "success": numbers(found.success), "num_looks": found.num_looks, "exponent": parts[0].exponent,
        "time_ns": [known.start_ns + round(at * 1e9) for at in found.time_s.tolist()], "success_by": found.success_by.tolist(),
        "next_look": None,
    }  # fmt: skip
    if (best := found.next_look) is not None:
        sensor = footprints[best.kind].sensor
        at = known.clock.moment(known.start_ns + round(span_s[1] * 1e9))
        place = place_words(known.frame, best.place_m)
        words.append(
            f"one more at {at}, all around as {sensor} sees, would have paid most at {place}: {100 * best.success:.2g} %"
        )
        told["next_look"] = {"place_m": list(best.place_m), "sensor": sensor, "success": best.success}
    return "; ".join(words), found, told


def _percent(found: Probability) -> str:
    """So many looks may leave so little that what is left is below all that stories can tell."""
    return f"more than {100 * found.low:.0f} %" if found.value > _NEARLY_ALL else percent(found)


def _parts(known: Known) -> tuple[Sequence[Footprint], tuple[Silence, ...]]:
    """The footprint of every kind of looks, and the looks: believed as by infer, with caution where that left silence out."""
    about = ((read_manifest("infer", known.directory) or {}).get("summary") or {}).get("silence") or {}
    exponent = float(about.get("exponent") or SAFE)
    looks = read_looks(known.directory, known.start_ns)
    footprints, parts = silences(looks, read_obstacles(known.directory / OBSTACLES_NAME), exponent)
    if not parts:
        raise InputError(f"{known.directory}: no sensor looked anywhere; see [[extract.sensors]] in docs/configuration.md")
    return footprints, parts
