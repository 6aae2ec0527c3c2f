"""Training windows of the general model: scenarios of synthetic kinematics, seen through the bank that will be used.

Each scenario is treated like a log: the bank is fitted to its detections alone, and its windows get the bank's posterior,
so that training sees exactly what inference will.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.bank.pool import BankPool, settings_of
from cadence.bank.rows import active_rows
from cadence.network.residual_context import MAX_DETECTIONS, ResidualContext, build_context
from cadence.types import Detections, WindowBatch
from cadence.worlds.kinematics import SUBSTEPS, SyntheticTracks, draw_scenario, simulate_tracks


@dataclass(frozen=True)
class SyntheticConfig:
    """How training windows are made; times in steps.

    history_steps, horizon_steps  the window grid
    num_tracks       targets of a scenario
    num_windows      windows of each target
    num_samples      samples of the bank kept for each window
    share_new        share of windows whose target has only just appeared
    """

    history_steps: int = 64
    horizon_steps: int = 32
    num_tracks: int = 10
    num_windows: int = 4
    num_samples: int = 8
    share_new: float = 0.25


@dataclass(frozen=True, eq=False)
class ResidualWindows:
    """Training windows: the context, the true residual [R, T, 2] and samples of the bank [R, K, T, 2], float32."""

    context: ResidualContext
    residual: Tensor
    sample: Tensor

    def __len__(self) -> int:
        return len(self.residual)

    def __getitem__(self, rows: slice | Tensor) -> "ResidualWindows":
        """A selection of windows."""
        return ResidualWindows(self.context[rows], self.residual[rows], self.sample[rows])


def synthesise(config: SyntheticConfig, seed: int, num_scenarios: int) -> ResidualWindows:
    """Windows of `num_scenarios` scenarios; the same seed gives the same windows."""
    parts = []
    for child in np.random.SeedSequence(seed).spawn(num_scenarios):
        part = _scenario_windows(config, np.random.default_rng(child))
        if part is not None:
            parts.append(part)
    return join_windows(parts)


def join_windows(parts: list[ResidualWindows]) -> ResidualWindows:
    """One set of several."""
    names = [field.name for field in dataclasses.fields(ResidualContext)]
    context = ResidualContext(*(torch.cat([getattr(part.context, name) for part in parts]) for name in names))
    return ResidualWindows(context, torch.cat([p.residual for p in parts]), torch.cat([p.sample for p in parts]))


def residual_windows(bank: Bank | BankPool, windows: WindowBatch, truth_m: Tensor, num_samples: int) -> ResidualWindows:
    """Training windows from the active agents of `windows` and the truth [B, A, T, 2] at every step."""
    rows, _ = active_rows(windows)
    posterior = bank.posterior(windows, num_samples)
    length_m = bank.length_m(windows.step_s)
    context = _padded(build_context(posterior, rows, windows.time_s, windows.step_s, length_m))
    scale = posterior.sigma_m[..., None]
    residual = (truth_m[windows.is_active] - posterior.mean_m) / scale
    sample = (posterior.sample_m - posterior.mean_m[:, None]) / scale[:, None]
    return ResidualWindows(context, residual.float(), sample.float())


def _padded(context: ResidualContext) -> ResidualContext:
    """The context with room for `MAX_DETECTIONS` in every window, so that windows of many scenarios can be joined."""
    missing = MAX_DETECTIONS - context.detections.shape[1]
    if missing <= 0:
        return context
    detections = torch.nn.functional.pad(context.detections, (0, 0, 0, missing))
    return dataclasses.replace(
        context, detections=detections, is_observed=torch.nn.functional.pad(context.is_observed, (0, missing))
    )


def _scenario_windows(config: SyntheticConfig, rng: np.random.Generator) -> ResidualWindows | None:
    num_steps = config.history_steps + config.horizon_steps
    length = 2 * config.history_steps + num_steps
    tracks = simulate_tracks(draw_scenario(rng), config.num_tracks, length, rng)
    noise = rng.normal(0.0, tracks.scenario.sigma, tracks.position.shape)
    seen = tracks.position + noise
    stretches = [
        _detections(tracks, seen, np.arange(config.num_tracks), begin, begin + config.history_steps)
        for begin in range(0, length, config.history_steps)
    ]
    fit_to = _stack(stretches)
    if int((fit_to.count > 1).sum()) < 4:
        return None
    bank = Bank().fit(fit_to, 1.0)
    if bank.log_weight is None:
        return None
    settings = settings_of(bank)
    bank = settings[int(rng.integers(len(settings)))]
    origins = rng.integers(config.history_steps, length - config.horizon_steps, (config.num_windows, config.num_tracks))
    return _windows_at(config, bank, tracks, seen, origins, rng)


def _windows_at(
    config: SyntheticConfig,
    bank: Bank | BankPool,
    tracks: SyntheticTracks,
    seen: np.ndarray,
    origins: np.ndarray,
    rng: np.random.Generator,
) -> ResidualWindows | None:
    num_steps = config.history_steps + config.horizon_steps
    grid = torch.arange(num_steps, dtype=torch.float64) - (config.history_steps - 1)
    parts, truths = [], []
    for track, origin in [(t, int(o)) for row in origins for t, o in enumerate(row)]:
        # some targets have only just appeared: their history is short
        is_new = rng.random() < config.share_new
        length = int(rng.integers(config.history_steps // 8, config.history_steps)) if is_new else config.history_steps
        window = _detections(tracks, seen, np.array([track]), origin - length, origin, after=True)
        parts.append(_moved(window, -length))
        truths.append(tracks.position[track, (origin + grid.numpy().astype(int)) * SUBSTEPS])
    detections = _stack(parts)
    seeds = torch.from_numpy(rng.integers(0, 2**60, len(truths)))
    windows = WindowBatch(grid, detections, seeds, config.history_steps - 1)
    truth = torch.from_numpy(np.stack(truths))[:, None]
    if not bool(windows.is_active.any()):
        return None
    return residual_windows(bank, windows, truth, config.num_samples)


def _detections(
    tracks: SyntheticTracks, seen: np.ndarray, which: np.ndarray, begin: int, end: int, after: bool = False
) -> Detections:
    """Detections of some tracks in [begin, end) steps, or (begin, end] with `after`; the first and last of every step."""
    low, high = begin * SUBSTEPS + after, min(end * SUBSTEPS + after, tracks.position.shape[1])
    low = max(low, 0)
    flags = tracks.is_detected[which, low:high]
    at = np.arange(low, high)
    cell = np.ceil(at / SUBSTEPS) if after else at // SUBSTEPS
    keep = np.zeros_like(flags)
    for row in range(len(which)):
        index = np.flatnonzero(flags[row])
        if len(index):
            first = np.append(True, np.diff(cell[index]) > 0)
            last = np.append(np.diff(cell[index]) > 0, True)
            keep[row, index[first | last]] = True
    num = max(1, int(keep.sum(1).max()))
    time, position = np.zeros((len(which), 1, num)), np.zeros((len(which), 1, num, 2))
    observed = np.zeros((len(which), 1, num), dtype=bool)
    for row, track in enumerate(which):
        index = np.flatnonzero(keep[row])
        time[row, 0, : len(index)] = (at[index] - begin * SUBSTEPS) / SUBSTEPS
        position[row, 0, : len(index)] = seen[track, at[index]]
        observed[row, 0, : len(index)] = True
    covariance = np.broadcast_to(tracks.scenario.sigma**2 * np.eye(2), (len(which), 1, num, 2, 2)).copy()
    return Detections(*(torch.from_numpy(value) for value in (time, position, covariance, observed)))


def _moved(detections: Detections, shift: float) -> Detections:
    """The same detections with `shift` added to their times."""
    return dataclasses.replace(detections, time_s=detections.time_s + shift)


def _stack(parts: list[Detections]) -> Detections:
    """Rows of several batches below one another, padded to the longest."""
    longest = max(part.time_s.shape[2] for part in parts)

    def padded(value: Tensor) -> Tensor:
        filler = torch.zeros(*value.shape[:2], longest - value.shape[2], *value.shape[3:], dtype=value.dtype)
        if value.ndim == 5:
            filler = filler + torch.eye(2, dtype=value.dtype)
        return torch.cat([value, filler], dim=2)

    names = [name for name, value in vars(parts[0]).items() if value is not None]
    return Detections(**{name: torch.cat([padded(getattr(part, name)) for part in parts]) for name in names})
