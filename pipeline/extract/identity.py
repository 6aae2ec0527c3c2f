"""Names that cannot say who was seen: detections that bear them are of unknown origin.

A name is believed as long as nothing contradicts it. What does, is said as a suspicion.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from pipeline.arrays import Bools
from pipeline.extract.covariances import are_apart
from pipeline.extract.plausibility import Suspicions
from pipeline.extract.positions import Positions, numbered

_MAX_SHARED: Final = 0.05
"""Of the messages that hold a name: with more in which it stands at several places it is no name at all; with fewer the odd
message is at fault (a tracker that splits a track for a moment), and only what it says is nobody's."""
_MAX_NAMED: Final = 3


def without_false_names(
    rows: Positions, tolerance_s: float, believed_topics: Collection[str], suspicions: Suspicions
) -> Positions:
    """The rows [N] of detections, in metres, with the agent taken away where it is no identity.

    Moments are the same within `tolerance_s`. Names on `believed_topics` are not looked at.
    """
    if not suspicions.looks_for("identity"):
        return rows
    is_judged = np.array([topic not in believed_topics for topic in rows.topic], np.bool_)
    return _without_shared(rows, is_judged, round(tolerance_s * 1e9), suspicions)


def _without_shared(rows: Positions, is_judged: Bools, tolerance_ns: int, suspicions: Suspicions) -> Positions:
    """Take names away that one message gives to several places at one moment."""
    agent = rows.agent.copy()
    is_shared = _is_shared(rows, tolerance_ns) & is_judged
    for topic in dict.fromkeys(rows.topic[is_shared]):
        of_topic = rows.topic == topic
        names = list(dict.fromkeys(rows.agent[of_topic & is_shared]))
        is_false = np.zeros(len(rows), np.bool_)
        for name in names:
            of_name = of_topic & (rows.agent == name)
            num_shared, num_messages = (len(np.unique(rows.message[found])) for found in (of_name & is_shared, of_name))
            is_false |= of_name if num_shared > _MAX_SHARED * num_messages else of_name & is_shared
        agent[is_false] = None
        num_messages = len(np.unique(rows.message[of_topic & is_shared]))
        suspicions.add(
            "identity", str(topic),
            seen=f"{num_messages} of {len(np.unique(rows.message[of_topic]))} messages have {_listed(names)} at several places",
            done=f"{int(is_false.sum())} detections are of unknown origin",
            setting="agent_path or has_identity (false: so be it, true: they are believed) in its [[extract.detections]]",
        )  # fmt: skip
    return replace(rows, agent=agent)


def _is_shared(rows: Positions, tolerance_ns: int) -> Bools:
    """Which rows [N] bear a name that another row of the same message and moment bears at a place that does not agree."""
    found = np.zeros(len(rows), np.bool_)
    name = numbered(rows.agent)
    named = np.flatnonzero(name >= 0)
    name = name[named]
    order = np.lexsort((rows.time_ns[named], name, rows.message[named]))
    name, ordered = name[order], named[order]
    before, after = ordered[:-1], ordered[1:]
    is_one = (rows.message[before] == rows.message[after]) & (name[:-1] == name[1:])
    is_one &= rows.time_ns[after] - rows.time_ns[before] <= tolerance_ns
    before, after = before[is_one], after[is_one]
    offset_m = np.column_stack([rows.first[after] - rows.first[before], rows.second[after] - rows.second[before]])
    apart = are_apart(offset_m, rows.covariance_m2[before], rows.covariance_m2[after])
    found[before[apart]] = found[after[apart]] = True
    return found


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(f'"{name}"' for name in names[:_MAX_NAMED])
    return shown + (f" and {len(names) - _MAX_NAMED} more names" if len(names) > _MAX_NAMED else "")
