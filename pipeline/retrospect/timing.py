"""At which times mission hypotheses stand: even steps where somebody is seen now and then, longer ones where nobody is.

All steps lie on multiples of one usual step, so that those of windows are among them where it is theirs. A gap, of all agents
together, that would take more than so many steps has longer ones, but for those beside its detections. So a month with
three detections and ten minutes at 100 Hz both get some hundreds to thousands of steps.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cadence.arrays import Int64s
from cadence.errors import ConfigError
from cadence.retrospect.timeline import Timeline
from pipeline.retrospect.config import RetrospectConfig
from pipeline.stories import Block, seconds_since

_MOST_STEPS = 200_000
"""What nobody can have meant, even where the step is stated."""


@dataclass(frozen=True, eq=False)
class Timing:
    """The steps of a mission.

    time_ns      [T]
    step_ns      the usual step
    block_steps  after so many steps models may change
    remarks      what a user should know of how they were chosen
    """

    time_ns: Int64s
    step_ns: int
    block_steps: int
    remarks: tuple[str, ...] = ()

    def timeline(self, unit_s: float) -> Timeline:
        """The steps as seconds since the first one; models of motion are stated in units of `unit_s`."""
        time_s = torch.from_numpy(seconds_since(int(self.time_ns[0]), self.blocks))
        return Timeline(time_s, torch.arange(0, len(time_s), self.block_steps), unit_s)

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Runs of even steps within stretches of the timeline."""
        apart_ns = np.diff(self.time_ns)
        found, first = [], 0
        while first < len(self.time_ns):
            end = min(len(self.time_ns), (first // self.block_steps + 1) * self.block_steps)
            same = apart_ns[first : end - 1]
            other = np.flatnonzero(same != same[0]) if len(same) else np.zeros(0, dtype=np.int64)
            stop = first + 1 + int(other[0]) if len(other) else end
            step_ns = int(same[0]) if stop > first + 1 else self.step_ns
            found.append(Block(first, stop, int(self.time_ns[first]), step_ns))
            first = stop
        return tuple(found)


def plan_times(seen_ns: Sequence[Int64s], config: RetrospectConfig, step_ns: int, block_steps: int) -> Timing:
    """The steps of a mission whose agents were detected at `seen_ns`.

    Args:
        seen_ns: of each agent, in any order, one at least.
        config: settings.
        step_ns: the step unless the settings state one.
        block_steps: likewise.
    """
    block_steps = config.block_steps or block_steps
    all_ns = np.unique(np.concatenate(list(seen_ns)))
    ends_ns = int(all_ns[0]) - round(config.before_s * 1e9), int(all_ns[-1]) + round(config.after_s * 1e9)
    if config.step_s is not None:
        stated_ns = max(1, round(config.step_s * 1e9))
        found = _times(all_ns, *ends_ns, stated_ns, config.gap_steps)
        if len(found) > _MOST_STEPS:
            raise ConfigError(f"retrospect.step_s = {config.step_s:g} takes {len(found)} steps; choose a longer one")
        return Timing(found, stated_ns, block_steps)
    most = min(config.max_steps, max(config.max_positions // (config.num_hypotheses * len(seen_ns)), 2))
    used_ns, found = step_ns, _times(all_ns, *ends_ns, step_ns, config.gap_steps)
    num_wanted = len(found)
    while len(found) > most:
        used_ns = step_ns * max(used_ns // step_ns + 1, math.ceil(used_ns / step_ns * len(found) / most * 0.98))
        found = _times(all_ns, *ends_ns, used_ns, config.gap_steps)
        if used_ns > ends_ns[1] - ends_ns[0]:
            break
    remarks = []
    if used_ns > step_ns:
        remarks.append(
            f"mission hypotheses have steps of {used_ns * 1e-9:g} s, not the {step_ns * 1e-9:g} s of the windows, as these "
            f"would take {num_wanted}; retrospect.max_steps and max_positions allow more or fewer, step_s sets the step"
        )
    return Timing(found, used_ns, block_steps, tuple(remarks))


def _times(seen_ns: Int64s, begin_ns: int, end_ns: int, step_ns: int, gap_steps: int) -> Int64s:
    """Steps from `begin_ns` to `end_ns` or just behind it on multiples of `step_ns` from the first detection on."""
    origin_ns = int(seen_ns[0])
    cell = np.unique((seen_ns - origin_ns) // step_ns)
    first, last = -(-(begin_ns - origin_ns) // step_ns), -((origin_ns - end_ns) // step_ns)
    first = min(first, (begin_ns - origin_ns) // step_ns)
    corner = np.unique(np.concatenate([[first], cell, cell + 1, [max(last, 1)]]))
    corner = corner[corner <= max(last, 1)]
    number = [corner[:1]]
    for low, high in itertools.pairwise(corner):
        stride = max(1, -(-(high - low) // gap_steps))
        inside = np.arange(low + stride, high, stride)
        number += [inside, np.array([high])]
    return np.asarray(origin_ns + step_ns * np.concatenate(number), dtype=np.int64)
