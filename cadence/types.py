"""Values that flow between the estimators: windows of detections in, weighted joint hypotheses out.

Letters of every shape: B window, K hypothesis, A agent, T time step, D space (2), N detection. Times are float seconds
relative to the window origin, positions float metres relative to the window datum (float64 in, see `pipeline.windows`).
"""

from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self

import torch
from torch import Tensor

from cadence.constraints.obstacles import Obstacles


@dataclass(frozen=True, eq=False)
class Detections:
    """Padded detections of every agent of every window, oldest first, padding last.

    time_s        [B, A, N] seconds relative to the window origin; padding repeats any finite value
    position_m    [B, A, N, 2] metres relative to the window datum
    covariance_m2 [B, A, N, 2, 2] symmetric positive definite position covariance
    is_observed   [B, A, N] bool, False on padding
    height_m      [B, A, N] metres up from the vertical datum, NaN where unknown; None where no detection has a height
    height_variance_m2  [B, A, N] NaN where not stated; None as above
    """

    time_s: Tensor
    position_m: Tensor
    covariance_m2: Tensor
    is_observed: Tensor
    height_m: Tensor | None = None
    height_variance_m2: Tensor | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.time_s.shape)
        expected = {"position_m": (*shape, 2), "covariance_m2": (*shape, 2, 2), "is_observed": shape}
        for name, want in expected.items():
            got = tuple(getattr(self, name).shape)
            if len(shape) != 3 or got != want:
                raise ValueError(f"Detections.{name} has shape {got}, expected {want} ([B, A, N] plus space)")
        if (self.height_m is None) != (self.height_variance_m2 is None):
            raise ValueError("Detections: height_m and height_variance_m2 go together")
        for height in (self.height_m, self.height_variance_m2):
            if height is not None and tuple(height.shape) != shape:
                raise ValueError(f"Detections: heights have shape {tuple(height.shape)}, expected {shape} ([B, A, N])")
        if self.is_observed.dtype != torch.bool:
            raise ValueError(f"Detections.is_observed must be bool, got {self.is_observed.dtype}")

    @property
    def count(self) -> Tensor:
        """Number of detections [B, A]."""
        return self.is_observed.sum(dim=-1)

    def __getitem__(self, windows: slice | Tensor) -> "Detections":
        """The same detections for a selection of windows (first axis)."""
        return Detections(**{name: value[windows] for name, value in vars(self).items() if value is not None})


@dataclass(frozen=True, eq=False)
class Tracks:
    """Whole tracks of B windows in the mission's frame and time, as evidence sees them.

    position_m [B, K, A, T, 2] float64 metres in the mission frame; NaN where an agent is no part of a hypothesis
    time_s     [B, T] float64 increasing seconds from the beginning of the mission
    agent_ids  names of the agents [A]; none where windows do not know any
    height_m   [B, K, A, T] float64 metres up, NaN where nothing is known; None where no track has a height
    """

    position_m: Tensor
    time_s: Tensor
    agent_ids: tuple[str, ...] = ()
    height_m: Tensor | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.position_m.shape)
        if len(shape) != 5 or shape[-1] != 2 or tuple(self.time_s.shape) != (shape[0], shape[3]):
            raise ValueError(f"Tracks: position_m {shape}, expected [B, K, A, T, 2]; time_s {tuple(self.time_s.shape)}, [B, T]")
        if self.agent_ids and len(self.agent_ids) != shape[2]:
            raise ValueError(f"Tracks: {len(self.agent_ids)} names of {shape[2]} agents")
        if self.height_m is not None and tuple(self.height_m.shape) != shape[:4]:
            raise ValueError(f"Tracks.height_m has shape {tuple(self.height_m.shape)}, expected {shape[:4]}")


class Evidence(Protocol):
    """Something known that speaks about whole tracks: silence of a sensor, bearings, a statement of the user.

    It holds what was observed where and when (sensors may move), in the mission's frame and time, so that it serves all
    windows. `cadence.evidence` weighs hypotheses by it; of a window it is shown the steps up to the origin.
    """

    @property
    def name(self) -> str:
        """What tables, advice and the report call it."""
        ...

    def log_likelihood(self, tracks: Tracks) -> Tensor:
        """How well each track fits: [B, K, A], or [B, K] where it speaks of all agents together.

        The logarithm of the likelihood over the greatest that any track could have: zero where nothing speaks against a
        track, never above zero, minus infinity where it cannot be. Agents that are no part of a hypothesis (NaN) add zero.
        """
        ...

    def touches(self, time_s: Tensor) -> Tensor:
        """Of which of the steps at `time_s` [B, T] it speaks [B, T]; windows without any are left as they are drawn."""
        ...

    def contradicts(self, tracks: Tracks, log_likelihood: Tensor) -> Tensor:
        """Where it speaks against all of the tracks together: [B, A], or [B] for all agents alike; `log_likelihood` is its own.

        There it is told and not believed. Weights cannot tell: they are the same whether tracks fit well or all of them badly.
        """
        ...


@dataclass(frozen=True, eq=False)
class Context:
    """What is known of B windows beside the detections: where they are, and what estimators may read or must obey there.

    datum_m       [B, 2] float64: what window positions are relative to, in the mission frame
    elapsed_s     [B] seconds from the beginning of the mission to the window origin
    known_goal_m  [B, A, 2] a goal that the searching side knows of, in the mission frame; NaN: none known
    tracker_m     [B, H, M, 2] positions of M moving trackers at the last H steps up to the origin, oldest first, in the
                  mission frame; NaN: absent
    obstacles     of the place, in the mission frame, the same for all windows; hypotheses keep out of them
    evidence      what else speaks about tracks, the same for all windows; hypotheses are weighed by it (`cadence.evidence`)
    agent_ids     names of the agents [A], by which evidence knows them; none where it need not
    """

    datum_m: Tensor
    elapsed_s: Tensor | None = None
    known_goal_m: Tensor | None = None
    tracker_m: Tensor | None = None
    obstacles: Obstacles = field(default_factory=Obstacles.none)
    evidence: tuple[Evidence, ...] = ()
    agent_ids: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        b = len(self.datum_m)
        if self.datum_m.shape != (b, 2):
            raise ValueError(f"Context.datum_m has shape {tuple(self.datum_m.shape)}, expected [B, 2]")
        for name, ndim in (("elapsed_s", 1), ("known_goal_m", 3), ("tracker_m", 4)):
            value = getattr(self, name)
            if value is not None and (value.ndim != ndim or len(value) != b):
                raise ValueError(f"Context.{name} has shape {tuple(value.shape)}, expected {ndim} axes, {b} windows first")

    def __getitem__(self, windows: slice | Tensor) -> "Context":
        """The same for a selection of windows."""
        given: dict[str, Any] = {name: value[windows] for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **given)

    def __len__(self) -> int:
        return len(self.datum_m)


@dataclass(frozen=True, eq=False)
class WindowBatch:
    """Windows that share one time grid.

    time_s     [T] step times relative to the origin, evenly spaced; time_s[origin_index] == 0
    detections see `Detections`; all lie at or before the origin (the future is what is asked for)
    seeds      [B] int64, one per window: a hypothesis depends on its window's seed, never on its neighbours in the batch
    origin_index  number of steps before the origin
    context    what is known beside the detections; None where nothing is, not even where the windows lie
    """

    time_s: Tensor
    detections: Detections
    seeds: Tensor
    origin_index: int
    context: Context | None = None

    def __post_init__(self) -> None:
        if self.time_s.ndim != 1 or not 0 <= self.origin_index < len(self.time_s):
            raise ValueError(f"WindowBatch: origin_index {self.origin_index} outside a grid of {tuple(self.time_s.shape)}")
        if self.context is not None and len(self.context) != self.num_windows:
            raise ValueError(f"WindowBatch: a context of {len(self.context)} windows for {self.num_windows}")
        if self.seeds.shape != self.detections.time_s.shape[:1]:
            raise ValueError(f"WindowBatch: {tuple(self.seeds.shape)} seeds for {self.num_windows} windows")

    @property
    def num_windows(self) -> int:
        """Number of windows B."""
        return int(self.detections.time_s.shape[0])

    @property
    def num_agents(self) -> int:
        """Number of agents A."""
        return int(self.detections.time_s.shape[1])

    @property
    def num_steps(self) -> int:
        """Number of time steps T."""
        return len(self.time_s)

    @property
    def step_s(self) -> float:
        """Seconds between two steps."""
        return float(self.time_s[1] - self.time_s[0])

    @property
    def is_active(self) -> Tensor:
        """Agents with at least one detection [B, A]; nothing can be said about the others."""
        return self.detections.is_observed.any(dim=-1)

    def __getitem__(self, windows: slice | Tensor) -> "WindowBatch":
        """The same grid for a selection of windows."""
        context = None if self.context is None else self.context[windows]
        return WindowBatch(self.time_s, self.detections[windows], self.seeds[windows], self.origin_index, context)

    def required_context(self, reader: str) -> Context:
        """The context, for a reader that cannot do without; ValueError names it where there is none."""
        if self.context is None:
            raise ValueError(f"{reader}: the windows do not say where they are; give their batch a context")
        return self.context

    def with_context(self, context: Context | None) -> "WindowBatch":
        """The same windows, of which something else is known."""
        return replace(self, context=context)


@dataclass(frozen=True, eq=False)
class HypothesisSet:
    """Weighted joint hypotheses.

    position_m [B, K, A, T, 2] metres relative to the window datum; NaN for agents that are not active
    weight     [B, K] non-negative, each row sums to one
    status     [B][A] "ok", "no_detections", "infeasible" (nothing keeps the limits), "scarce" (hardly anything does), ...
    num_effective  [B, A] effective sample size: so many equally weighted tracks would tell as much; None where no evidence
               weighs hypotheses
    height_m   [B, K, A, T] metres up from the vertical datum, NaN for agents without any height; None where no agent has one
    """

    position_m: Tensor
    weight: Tensor
    status: tuple[tuple[str, ...], ...]
    num_effective: Tensor | None = None
    height_m: Tensor | None = None

    def __post_init__(self) -> None:
        b, k, a = self.position_m.shape[:3]
        if self.position_m.ndim != 5 or self.position_m.shape[-1] != 2:
            raise ValueError(f"HypothesisSet.position_m has shape {tuple(self.position_m.shape)}, expected [B, K, A, T, 2]")
        if tuple(self.weight.shape) != (b, k):
            raise ValueError(f"HypothesisSet.weight has shape {tuple(self.weight.shape)}, expected {(b, k)}")
        if self.height_m is not None and self.height_m.shape != self.position_m.shape[:-1]:
            raise ValueError(f"HypothesisSet.height_m has shape {tuple(self.height_m.shape)}, expected [B, K, A, T]")
        if len(self.status) != b or any(len(row) != a for row in self.status):
            raise ValueError("HypothesisSet.status must hold one word per window and agent")
        if self.num_effective is not None and tuple(self.num_effective.shape) != (b, a):
            raise ValueError(f"HypothesisSet.num_effective has shape {tuple(self.num_effective.shape)}, expected {(b, a)}")


class Estimator(Protocol):
    """What the diffusion model and every rival implement: the same call, joint samples out.

    All that is known of a window is in the window: its detections, and its context. An estimator reads of the context what it
    can; obstacles it either obeys or knows nothing of.
    """

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    def fit(self, tracks: Detections) -> Self:
        """The estimator adapted to one log by the likelihood of its detections (empirical Bayes); no truth involved.

        `tracks` holds one uninterrupted stretch of one agent's detections per row ([B, 1, N], any time origin a row).
        Estimators without anything to adapt return themselves.
        """
        ...

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Draw joint hypotheses; deterministic in `windows.seeds`."""
        ...
