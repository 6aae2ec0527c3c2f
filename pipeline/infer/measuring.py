"""What sensors measured of agents beside positions: evidence for their windows, and tracks drawn from it where it is sharp."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cadence.bank.bank import Bank
from cadence.bearings.estimator import WithBearings
from cadence.constraints.agility import Agility
from cadence.diffusion.settings import GuidanceConfig
from cadence.evidence.estimator import WithEvidence
from cadence.evidence.measurements import Measurements
from cadence.evidence.settings import WeighingConfig
from cadence.types import Evidence
from pipeline.counted import counted
from pipeline.suspicions import listed
from pipeline.windows import MissionWindows


@dataclass(frozen=True, eq=False)
class HeardMeasurements:
    """Evidence of measurements, and what the summary and a remark say of it."""

    evidence: tuple[Evidence, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def told_of(found: Measurements | None, config: WeighingConfig) -> tuple[str, ...]:
    """Whom bearings or ranges tell of by name, in order of the names."""
    if found is None or not config.is_used:
        return ()
    is_told = np.isfinite(found.bearing_rad) | np.isfinite(found.range_m)
    return tuple(sorted({name for name in found[is_told].agent_ids if name is not None}))


def with_unseen(windows: MissionWindows, found: Measurements | None, config: WeighingConfig) -> MissionWindows:
    """The windows, with those of whom bearings or ranges tell and no position is known behind the others."""
    names = [name for name in told_of(found, config) if name not in windows.agent_ids]
    return windows.with_unseen(names, found.observer_m[0]) if found is not None and names else windows


def drawn_by_measurements(
    weighed: WithEvidence, fitted: Bank, config: WeighingConfig, guidance: GuidanceConfig, step_s: float
) -> WithBearings:
    """What draws, and beside it the bank for agents of whom measurements tell more than weighing reaches."""
    limits = None
    if guidance.mode != "none":
        longest_m = None if guidance.max_speed_mps is None else guidance.max_speed_mps * step_s
        stated = guidance.max_acceleration_mps2, guidance.max_turn_rate_dps, longest_m
        limits = Agility.stated(*stated, step_s, fitted.length_m(step_s))
    return WithBearings(weighed, fitted, config.reach_m, limits=limits, margin_m=guidance.margin_m)


def hear_measurements(found: Measurements | None, config: WeighingConfig, agents: Sequence[str]) -> HeardMeasurements:
    """The measurements that are about `agents`, those of the windows; without a name where there is only one of them."""
    if found is None or not config.is_used:
        return HeardMeasurements()
    is_about = np.array([name in agents if name is not None else len(agents) == 1 for name in found.agent_ids], dtype=np.bool_)
    used, others = found[is_about], Counter(name for name in found[~is_about].agent_ids if name is not None)
    remarks = []
    if others:
        number = counted(sum(others.values()), "measurement is", "measurements are")
        remarks.append(f"{number} about {listed(sorted(others))}, of whom no position is known, and are not used here")
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
