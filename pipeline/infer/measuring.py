"""What sensors measured of agents beside positions: evidence for their windows, and whom it is about that nobody can draw."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cadence.evidence.measurements import Measurements
from cadence.evidence.settings import WeighingConfig
from cadence.types import Evidence
from pipeline.counted import counted
from pipeline.suspicions import listed


@dataclass(frozen=True, eq=False)
class HeardMeasurements:
    """Evidence of measurements, and what the summary and a remark say of it."""

    evidence: tuple[Evidence, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def hear_measurements(found: Measurements | None, config: WeighingConfig, agents: Sequence[str]) -> HeardMeasurements:
    """The measurements that are about `agents`, those of the windows; without a name where there is only one of them."""
    if found is None or not config.is_used:
        return HeardMeasurements()
    is_about = np.array([name in agents if name is not None else len(agents) == 1 for name in found.agent_ids], dtype=np.bool_)
    used, others = found[is_about], Counter(name for name in found[~is_about].agent_ids if name is not None)
    remarks = []
    if others:
        number = counted(sum(others.values()), "measurement is", "measurements are")
        remarks.append(f"{number} about {listed(sorted(others))}, of whom no position is known: nobody can draw them yet")
    num_nameless = sum(name is None for name in found[~is_about].agent_ids)
    if num_nameless:
        number = counted(num_nameless, "measurement says", "measurements say")
        whose = f"which of {len(agents)} agents" if agents else "whom"
        remarks.append(
            f"{number} not {whose} they are about and are not used; agent, or agent_path, in [[extract.detections]] does"
        )
    told = Counter(name for name in used.agent_ids if name is not None)
    about = {"num_used": len(used), "num_not_used": int((~is_about).sum()), "agents": dict(sorted(told.items()))}
    return HeardMeasurements((used,) if len(used) else (), {"measurements": about}, tuple(remarks))
