"""What the looks of a mission's sensors say: evidence for its windows, with an exponent that withheld detections chose."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from cadence.arrays import Float64s
from cadence.bank.hindsight import withhold
from cadence.constraints.obstacles import Obstacles
from cadence.evidence.exponents import SAFE, ChosenExponent, choose_exponent
from cadence.evidence.settings import WeighingConfig
from cadence.evidence.silence import Looks, Silence, ground_of
from cadence.types import Estimator, Evidence
from pipeline.looks import Footprint, silences
from pipeline.windows import MissionWindows

_NUM_TESTED = 40
_LEAST_HISTORY = 8
"""Steps that a grid needs before now for withheld detections to lie on it."""


@dataclass(frozen=True, eq=False)
class HeardSilence:
    """Evidence of silence, and what the summary and a remark say of it."""

    evidence: tuple[Evidence, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def hear_silence(
    looks: Sequence[tuple[Footprint, Looks]], obstacles: Obstacles, config: WeighingConfig, estimator: Estimator,
    windows: MissionWindows, start_ns: int, knows_standing: bool,
) -> HeardSilence:  # fmt: skip
    """The silence that counts for an estimator.

    Args:
        looks: of the mission's footprints.
        obstacles: that may hide.
        config: whose exponent counts, where it states one.
        estimator: fitted to the log.
        windows: by name, without context.
        start_ns: when the mission began.
        knows_standing: sensors that stand are in the estimator's tracks already, and must not count twice.
    """
    if not looks or not config.is_used:
        return HeardSilence()
    heard = [(footprint, some) for footprint, some in looks if not (knows_standing and footprint.is_standing)]
    remarks = []
    if len(heard) < len(looks):
        remarks.append("silence of sensors that stand is left out: this checkpoint has learned it with its tracks")
    _, parts = silences(heard, obstacles, SAFE)
    if not parts:
        return HeardSilence(remarks=tuple(remarks))
    ground = ground_of([some for _, some in looks], *_sightings(windows, start_ns))
    parts = tuple(replace(part, ground=ground) for part in parts)
    if config.exponent is None:
        chosen = _chosen(parts, estimator, windows, start_ns)
    else:
        chosen = ChosenExponent(config.exponent, 0, {})
    if chosen.exponent == 0.0:
        why = "hypotheses weighed by it foresee withheld detections worse" if config.exponent is None else "it is set so"
        remarks.append(f"silence of sensors is not used: {why} (infer.evidence.exponent)")
        parts = ()
    evidence = tuple(replace(part, exponent=chosen.exponent) for part in parts)
    about = {
        "exponent": chosen.exponent,
        "num_tests": chosen.num_tests,
        "ratios": {f"{exponent:g}": ratio for exponent, ratio in chosen.ratios.items()},
        "num_looks": sum(len(some) for _, some in heard),
        "sensors": sorted({footprint.sensor for footprint, _ in heard}),
    }
    return HeardSilence(evidence, {"silence": about}, tuple(remarks))


def _sightings(windows: MissionWindows, start_ns: int) -> tuple[Float64s, Float64s]:
    """When [D], in seconds from the beginning of the mission, and where [D, 2] agents were seen."""
    seen = windows.batch.detections
    is_seen = seen.is_observed.numpy()
    at_s = ((windows.origins_ns - start_ns) * 1e-9)[:, None, None] + seen.time_s.numpy()
    place_m = windows.datum_m[:, None, None] + seen.position_m.numpy()
    return at_s[is_seen], place_m[is_seen]


def _chosen(parts: Sequence[Silence], estimator: Estimator, windows: MissionWindows, start_ns: int) -> ChosenExponent:
    """By bursts that are withheld from some of the windows, evenly spread."""
    if windows.batch.origin_index < _LEAST_HISTORY:
        return ChosenExponent(SAFE, 0, {})
    located = windows.located(start_ns, Obstacles.none()).batch
    shown, withheld = withhold(located, 0)
    useful = torch.nonzero(withheld.is_observed.any(-1).any(-1))[:, 0]
    if not len(useful):
        return ChosenExponent(SAFE, 0, {})
    pick = useful[torch.linspace(0, len(useful) - 1, min(_NUM_TESTED, len(useful))).round().long()]
    return choose_exponent(estimator, shown[pick], withheld[pick], parts)
