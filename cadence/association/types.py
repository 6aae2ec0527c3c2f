"""Settings and results of data association. Arrays are numpy: labels, not tensors that a network sees."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cadence.arrays import Float64s, Int64s

_LEAST_PROBABILITY = 0.5
CLUTTER = -1
"""Label of a detection that no agent caused."""


@dataclass(frozen=True)
class AssociationConfig:
    """How detections of unknown origin are told apart.

    num_agents     how many agents there are, all through the log; None: unknown, agents come and go
    max_agents     where the number is unknown: never more than this
    num_particles  association hypotheses that are followed side by side
    num_associations  those that are drawn at a window origin, without bias, from all that the particles stand for; the older
                   name, num_ways, is still read
    clutter_share  share of the detections that no agent caused; None: fitted to the stream
    """

    num_agents: int | None = None
    max_agents: int = 64
    num_particles: int = 200
    num_associations: int = field(default=60, metadata={"older_name": "num_ways"})
    clutter_share: float | None = None

    def __post_init__(self) -> None:
        if self.num_agents is not None and self.num_agents < 1:
            raise ValueError("num_agents must be at least 1, or None")
        if min(self.max_agents, self.num_particles, self.num_associations) < 1:
            raise ValueError("max_agents, num_particles and num_associations must be at least 1")
        if self.clutter_share is not None and not 0.0 <= self.clutter_share < 1.0:
            raise ValueError("clutter_share must lie in [0, 1), or be None")


@dataclass(frozen=True, eq=False)
class AssociationHypotheses:
    """What a stream's detections up to one moment may have come from: M weighted association hypotheses (Reid 1979).

    label       [M, N] int64: agent 0 .. num_agents - 1 of each of the N detections known at that moment, -1 clutter
    weight      [M] non-negative, sums to one; first the hypothesis that agrees most with all
    num_agents  agents that are numbered in the log as a whole; some may have no detection yet
    """

    label: Int64s
    weight: Float64s
    num_agents: int

    def __post_init__(self) -> None:
        if self.label.ndim != 2 or self.weight.shape != self.label.shape[:1] or len(self.weight) == 0:
            raise ValueError(
                f"AssociationHypotheses: labels {self.label.shape} and weights {self.weight.shape}; expected [M, N] and [M]"
            )
        if np.any(self.weight < 0) or abs(float(self.weight.sum()) - 1.0) > 1e-6:
            raise ValueError("AssociationHypotheses.weight must not be negative and must sum to one")
        if self.label.size and not CLUTTER <= int(self.label.min()) <= int(self.label.max()) < self.num_agents:
            raise ValueError(f"AssociationHypotheses.label must lie in [-1, {self.num_agents})")

    @property
    def num_associations(self) -> int:
        """Number of association hypotheses M."""
        return len(self.weight)

    @property
    def num_detections(self) -> int:
        """Number of detections N."""
        return int(self.label.shape[1])


def without_unlikely(moments: Sequence[AssociationHypotheses]) -> list[AssociationHypotheses]:
    """The same at each moment without the agents that at none of them are likelier there than not: theirs is clutter.

    The second detection of a target may as well be another's; once there are three nobody thinks so.
    """
    num_agents = max((found.num_agents for found in moments), default=0)
    most = np.zeros(num_agents)
    for found in moments:
        for agent in range(found.num_agents):
            most[agent] = max(most[agent], found.weight @ (found.label == agent).any(axis=1))
    is_likely = most > _LEAST_PROBABILITY
    name = np.append(np.where(is_likely, np.cumsum(is_likely) - 1, CLUTTER), CLUTTER)  # the last answers for clutter
    return [AssociationHypotheses(name[found.label], found.weight, int(is_likely.sum())) for found in moments]


def agent_probability(associations: AssociationHypotheses) -> Float64s:
    """P(detection came from agent) [N, A + 1], rows sum to one; the last column is clutter."""
    num_agents = associations.num_agents
    out = np.zeros((associations.num_detections, num_agents + 1))
    column = np.where(associations.label == CLUTTER, num_agents, associations.label)
    detection = np.broadcast_to(np.arange(associations.num_detections), column.shape)
    np.add.at(out, (detection, column), np.broadcast_to(associations.weight[:, None], column.shape))
    return out
