"""Detections put into samples of networks in absolute coordinates: overwriting cells, or a correction spread smoothly.

Everything is vectorised over R rows (one agent of one window) and K hypotheses a row. Times are counted in steps since the
first step of the grid. The residual model must not use any of this: its bank has the detections in it already.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_FLOOR = 1e-9


@dataclass(frozen=True, eq=False)
class GridDetections:
    """Detections of R rows on a grid of T steps.

    at         [R, N] time in steps since the first step; fractions lie between steps
    position   [R, N, 2] in any unit
    covariance [R, N, 2, 2] in its square; zero for exact detections
    is_used    [R, N] bool: observed, and inside the grid
    num_steps  T
    """

    at: Tensor
    position: Tensor
    covariance: Tensor
    is_used: Tensor
    num_steps: int


def grid_detections(at: Tensor, position: Tensor, covariance: Tensor, is_observed: Tensor, num_steps: int) -> GridDetections:
    """The detections of R rows as `GridDetections`, left-packed; those before the first or after the last step are left out."""
    is_used = is_observed & (at >= -1e-6) & (at <= num_steps - 1 + 1e-6)
    num_kept = max(1, int(is_used.sum(dim=1).max())) if len(is_used) else 1
    pick = torch.argsort((~is_used).int(), dim=1, stable=True)[:, :num_kept]
    return GridDetections(
        at.gather(1, pick).clamp(0.0, num_steps - 1.0),
        position.gather(1, pick[..., None].expand(-1, -1, 2)),
        covariance.gather(1, pick[..., None, None].expand(-1, -1, 2, 2)),
        is_used.gather(1, pick),
        num_steps,
    )


@dataclass(frozen=True, eq=False)
class KnownCells:
    """What overwriting knows: position [R, T, 2], zero where nothing is known, and is_known [R, T]."""

    position: Tensor
    is_known: Tensor


def known_cells(detections: GridDetections) -> KnownCells:
    """Each step's nearest detection within half a step: covariance and the time within the step are lost."""
    steps = torch.arange(detections.num_steps, dtype=detections.at.dtype, device=detections.at.device)
    apart = (detections.at[:, None] - steps[:, None]).abs()
    apart = apart.masked_fill(~detections.is_used[:, None], math.inf)
    nearest = apart.min(dim=-1)
    is_known = nearest.values <= 0.5
    position = detections.position.gather(1, nearest.indices[..., None].expand(-1, -1, 2))
    return KnownCells(torch.where(is_known[..., None], position, torch.zeros_like(position)), is_known)


def overwritten(state: Tensor, cells: KnownCells) -> Tensor:
    """`state` [R, K, T, 2] with the known cells set to the detections, exactly (the paper's procedure)."""
    return torch.where(cells.is_known[:, None, :, None], cells.position[:, None].to(state.dtype), state)


def overwritten_at_level(state: Tensor, cells: KnownCells, angle: float, noise: Tensor) -> Tensor:
    """`state` [R, K, T, 2] with the known cells set to detections noised to the level `angle` by `noise`, like state."""
    known = math.cos(angle) * cells.position[:, None].to(state.dtype) + math.sin(angle) * noise
    return torch.where(cells.is_known[:, None, :, None], known, state)


@dataclass(frozen=True, eq=False)
class Correction:
    """A clean estimate's pull onto the detections: x + G (z + e - H x), once computed, then two products a step.

    gain     [R, T, 2, N, 2] G: zero for detections that are not used
    observe  [R, N, T] H: linear interpolation between the two steps around each detection
    position [R, N, 2] z
    factor   [R, N, 2, 2] Cholesky factor of the covariances, for the draws e
    sigma    [R, T] standard deviation an axis of the process given the detections
    """

    gain: Tensor
    observe: Tensor
    position: Tensor
    factor: Tensor
    sigma: Tensor

    def __call__(self, clean: Tensor, noise: Tensor | None = None) -> Tensor:
        """`clean` [R, K, T, 2] corrected.

        Args:
            clean: the estimate.
            noise: [R, K, N, 2] standard normal, one draw for each hypothesis and kept through all sampling steps: with it
                hypotheses spread as the covariances say (Matheron's rule); without it they share the detections.
        """
        wanted = self.position[:, None]
        if noise is not None:
            wanted = wanted + torch.einsum("rnij,rknj->rkni", self.factor, noise)
        missing = wanted - torch.einsum("rnt,rktd->rknd", self.observe, clean)
        r, k, t, d = clean.shape
        gain = self.gain.reshape(r, t * d, -1)
        moved: Tensor = clean + torch.einsum("rpq,rkq->rkp", gain, missing.reshape(r, k, -1)).reshape(r, k, t, d)
        return moved


def smoother_correction(
    detections: GridDetections, length_steps: float = 8.0, amplitude: float = 0.5, dtype: torch.dtype = torch.float32
) -> Correction:
    """The gain of a Gaussian process for the error of a clean estimate: Matérn 3/2, the same for both axes.

    Its sample paths have a velocity, so that a correction bends a track and never breaks it.

    Args:
        detections: R rows.
        length_steps: length of the kernel, in steps: how far along the track a detection is felt.
        amplitude: standard deviation of the error far from detections, in the positions' unit. Large against the
            detections' sigma: a correction at every sampling step then counts a detection about once.
        dtype: of the result; it is computed in float64.
    """
    num_steps = detections.num_steps
    observe = _interpolation(detections)
    kernel = amplitude**2 * _matern(num_steps, length_steps).to(observe.device)
    cross = kernel @ observe.mT  # [R, T, N]
    r, n = detections.at.shape
    eye = torch.eye(2, dtype=torch.float64, device=observe.device)
    is_used = detections.is_used
    # an unused detection is a row of its own with variance one and no gain
    covariance = torch.where(is_used[..., None, None], detections.covariance.double(), eye)
    within = torch.einsum("rnm,ij->rnimj", observe @ cross, eye).reshape(r, 2 * n, 2 * n)
    within = within + torch.diag_embed(torch.full((r, 2 * n), _FLOOR * amplitude**2, dtype=torch.float64, device=eye.device))
    noise = torch.einsum("rnij,nm->rnimj", covariance, torch.eye(n, dtype=torch.float64, device=eye.device))
    within = within + noise.reshape(r, 2 * n, 2 * n)
    wide = torch.einsum("rtn,ij->rtinj", cross, eye).reshape(r, 2 * num_steps, 2 * n)
    gain = torch.cholesky_solve(wide.mT, torch.linalg.cholesky(within)).mT
    left = kernel.diagonal() - 0.5 * (gain * wide).sum(-1).reshape(r, num_steps, 2).sum(-1)
    factor = torch.linalg.cholesky(covariance + _FLOOR * amplitude**2 * eye)
    return Correction(
        gain=gain.reshape(r, num_steps, 2, n, 2).to(dtype),
        observe=observe.to(dtype),
        position=torch.where(is_used[..., None], detections.position, 0.0).to(dtype),
        factor=factor.to(dtype),
        sigma=left.clamp_min(0.0).sqrt().to(dtype),
    )


def _interpolation(detections: GridDetections) -> Tensor:
    """Rows [R, N, T] that take a track at each detection's time; zero for detections that are not used."""
    at = detections.at.double()
    before = at.floor().clamp(0, max(detections.num_steps - 2, 0))
    share = at - before
    steps = torch.arange(detections.num_steps, dtype=torch.float64, device=at.device)
    first = (steps == before[..., None]).double() * (1.0 - share)[..., None]
    second = (steps == before[..., None] + 1).double() * share[..., None]
    return (first + second) * detections.is_used[..., None]


def _matern(num_steps: int, length_steps: float) -> Tensor:
    """Correlation [T, T] of the Matérn 3/2 process on a grid of unit steps."""
    steps = torch.arange(num_steps, dtype=torch.float64)
    distance = math.sqrt(3.0) / length_steps * (steps[:, None] - steps).abs()
    return (1.0 + distance) * torch.exp(-distance)
