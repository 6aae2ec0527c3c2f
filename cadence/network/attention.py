"""Attention between the agents of a window, so that their tracks are drawn together.

Ye, Natarajan, Wu, Gombolay, "Diffusion Models for Multi-target Adversarial Tracking" (CADENCE, MRS 2023), section IV: agents
share all weights, and each attends to the tracks of the others between the convolutions of the U-Net. Vaswani et al.,
"Attention is all you need" (2017).
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

MAX_AGENTS = 64
"""Agents of one window that attend to each other; the cost grows with the square of their number."""


@dataclass(frozen=True, eq=False)
class Team:
    """Which rows of a batch move together: rows are B windows of A agents with K samples each, in this order of axes.

    is_present   [B, A] bool; the rows of absent agents are computed but seen by nobody
    num_samples  K rows in a row for every agent; sample k of an agent sees sample k of the others
    """

    is_present: Tensor
    num_samples: int = 1

    def __post_init__(self) -> None:
        if self.is_present.ndim != 2 or self.is_present.dtype != torch.bool:
            raise ValueError(f"Team.is_present must be bool [B, A], got {self.is_present.dtype} {tuple(self.is_present.shape)}")
        if self.num_agents > MAX_AGENTS:
            raise ValueError(f"Team: {self.num_agents} agents in a window; at most {MAX_AGENTS} can attend to each other")

    @property
    def num_agents(self) -> int:
        """Agents A of a window, absent ones included."""
        return int(self.is_present.shape[1])

    def __getitem__(self, windows: slice | Tensor) -> "Team":
        """The same for a selection of windows."""
        return Team(self.is_present[windows], self.num_samples)

    def repeated(self, times: int) -> "Team":
        """Every row `times` times in a row."""
        return Team(self.is_present, self.num_samples * times)


class AgentAttention(nn.Module):
    """States [R, C, P] of R = B * A * K tracks with P pieces, each plus what its agent reads from the other agents.

    Every agent's keys and values are computed once, for all who read them. With form "joint" one softmax weighs the pieces of
    all other agents, and that of reading nothing (a key and a value of zeros); with form "paired", the paper's, there is a
    softmax for each other agent, and what they give is summed. An agent without others keeps its state: so one agent is the
    single-target model. Permuting the agents of a window permutes the answer.
    """

    def __init__(self, channels: int, num_heads: int, num_groups: int, form: Literal["joint", "paired"] = "joint") -> None:
        super().__init__()
        if channels % num_heads:
            raise ValueError(f"AgentAttention: {channels} channels cannot be shared among {num_heads} heads")
        self.num_heads, self.form = num_heads, form
        self.norm = nn.GroupNorm(num_groups, channels)
        self.read = nn.Conv1d(channels, 3 * channels, 1)
        # without a bias: who reads nothing adds nothing
        self.write = nn.Conv1d(channels, channels, 1, bias=False)
        nn.init.zeros_(self.write.weight)

    def forward(self, hidden: Tensor, team: Team) -> Tensor:
        """See the class."""
        b, a = team.is_present.shape
        if a == 1:
            return hidden
        rows, channels, pieces = hidden.shape
        heads = self.num_heads
        tokens = self.read(self.norm(hidden)).reshape(b, a, team.num_samples, 3, heads, channels // heads, pieces)
        # [3][B, K, heads, A, P, C / heads]
        query, key, value = tokens.permute(3, 0, 2, 4, 1, 6, 5)
        is_read = team.is_present[:, None, :] & ~torch.eye(a, dtype=torch.bool)  # [B, reader, read]
        read = _joint(query, key, value, is_read) if self.form == "joint" else _paired(query, key, value, is_read)
        # [B, K, heads, A, P, C / heads] -> [B, A, K, heads, C / heads, P]
        back = read.permute(0, 3, 1, 2, 5, 4).reshape(rows, channels, pieces)
        result: Tensor = hidden + self.write(back)
        return result


def _joint(query: Tensor, key: Tensor, value: Tensor, is_read: Tensor) -> Tensor:
    """One softmax over the pieces of all agents that are read, and over nothing; [B, K, heads, A, P, C / heads] each."""
    b, k, heads, a, pieces, size = query.shape
    # plain products: on a CPU torch's own attention takes twice as long for so few pieces
    q, k_, v = (part.reshape(b * k * heads, a * pieces, size) for part in (query, key, value))
    logits = torch.bmm(q, k_.mT).reshape(b, k * heads, a, pieces, a, pieces) / size**0.5
    logits = logits.masked_fill(~is_read[:, None, :, None, :, None], -math.inf).reshape(b * k * heads, a * pieces, -1)
    greatest = logits.detach().amax(dim=-1, keepdim=True).clamp_min(0.0)  # the logit of reading nothing is 0
    share = (logits - greatest).exp()
    weight = share / (share.sum(dim=-1, keepdim=True) + (-greatest).exp())
    return torch.bmm(weight.to(v.dtype), v).reshape(query.shape)


def _paired(query: Tensor, key: Tensor, value: Tensor, is_read: Tensor) -> Tensor:
    """A softmax over the pieces of each agent that is read, summed over these agents."""
    logits = torch.einsum("bkhipc,bkhjqc->bkhijpq", query, key) / query.shape[-1] ** 0.5
    weight = logits.softmax(dim=-1) * is_read[:, None, None, :, :, None, None]
    return torch.einsum("bkhijpq,bkhjqc->bkhipc", weight, value)
