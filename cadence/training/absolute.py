"""The loss of networks in absolute coordinates: the paper's uniform mean square error, over random noise levels."""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.rows import active_rows
from cadence.diffusion.absolute import AbsoluteConfig, absolute_frame
from cadence.network.trajectory import TrajectoryNetwork
from cadence.recordings import ForecastWindows
from cadence.schedule import Schedule, target_of


@dataclass(frozen=True, eq=False)
class AbsoluteWindows:
    """Training windows, one agent a row, in normalised units, float32.

    clean       [R, T, 2] the true trajectory; any finite value where it is not known
    is_known    [R, T] bool
    rows        [R, N, 3] age, x, y of the last detections, oldest first
    is_observed [R, N] bool, False on padding
    extra       [R, E] further inputs (goal, elapsed share), or None
    """

    clean: Tensor
    is_known: Tensor
    rows: Tensor
    is_observed: Tensor
    extra: Tensor | None = None

    def __len__(self) -> int:
        return len(self.clean)

    def __getitem__(self, pick: slice | Tensor) -> "AbsoluteWindows":
        """A selection of windows."""
        extra = None if self.extra is None else self.extra[pick]
        return AbsoluteWindows(self.clean[pick], self.is_known[pick], self.rows[pick], self.is_observed[pick], extra)


def join_absolute(parts: list[AbsoluteWindows]) -> AbsoluteWindows:
    """One set of several, all with rows of one length."""
    extras = [part.extra for part in parts if part.extra is not None]
    return AbsoluteWindows(
        torch.cat([part.clean for part in parts]),
        torch.cat([part.is_known for part in parts]),
        torch.cat([part.rows for part in parts]),
        torch.cat([part.is_observed for part in parts]),
        torch.cat(extras) if extras else None,
    )


def forecast_rows(windows: ForecastWindows, config: AbsoluteConfig) -> AbsoluteWindows:
    """Forecasting windows in the network's units; those without any detection are left out. They are known to the last step."""
    nodes, _ = active_rows(windows.windows)
    window, agent = windows.windows.is_active.nonzero(as_tuple=True)
    frame = absolute_frame(nodes, window, agent, windows.context, config)
    clean = ((windows.truth_m[window, agent] - frame.centre_m[:, None]) / config.scale_m).float()
    is_known = torch.ones(clean.shape[:2], dtype=torch.bool)
    return AbsoluteWindows(clean, is_known, *frame.detection_rows(config), None if frame.extra is None else frame.extra[:, 0])


def absolute_loss(
    network: TrajectoryNetwork, windows: AbsoluteWindows, schedule: Schedule, generator: torch.Generator
) -> Tensor:
    """Mean square error of the network's answer over the known steps, each window at a noise level of its own."""
    levels = torch.randint(len(schedule), (len(windows),), generator=generator)
    angle = schedule.angle[levels].float()
    noise = torch.randn(windows.clean.shape, generator=generator)
    level = angle[:, None, None]
    noisy = torch.cos(level) * windows.clean + torch.sin(level) * noise
    extra = None if windows.extra is None else windows.extra[:, None]
    code = network.encode(windows.rows[:, None], windows.is_observed[:, None], extra)
    answer = network(noisy[:, None], angle, code)[:, 0].float()
    error = (answer - target_of(network.config.prediction, windows.clean, noise, level)).square().mean(dim=-1)
    is_known = windows.is_known.to(error.dtype)
    loss: Tensor = (error * is_known).sum() / is_known.sum().clamp_min(1.0)
    return loss
