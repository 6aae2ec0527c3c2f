"""Motion models as one linear stochastic differential equation with three parameters.

With the plane read as complex numbers, position p and velocity v follow

    dp = v dt,    dv = (-1/relaxation + i * turn_rate) v dt + noise of intensity `diffusion`

which is constant velocity for no relaxation and no turn, integrated Ornstein-Uhlenbeck with relaxation, and a coordinated
turn with a turn rate (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", ch. 6 and 11).
Everything is closed form, so that detections may lie at any times.
"""

import itertools
from dataclasses import dataclass
from types import EllipsisType

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class MotionModels:
    """C motion models, float64 tensors [C] in consistent units (seconds and metres, or steps and step lengths).

    relaxation_rate  1/s, zero for constant velocity
    turn_rate        rad/s, positive to the left
    diffusion        m^2/s^3 and axis: intensity of the acceleration noise
    initial_speed    m/s and axis: standard deviation of the velocity where nothing is known yet
    """

    relaxation_rate: Tensor
    turn_rate: Tensor
    diffusion: Tensor
    initial_speed: Tensor

    def __post_init__(self) -> None:
        shapes = {tuple(value.shape) for value in (self.relaxation_rate, self.turn_rate, self.diffusion, self.initial_speed)}
        if len(shapes) != 1 or self.relaxation_rate.ndim != 1:
            raise ValueError(f"MotionModels: parameters must share one shape [C], got {sorted(shapes)}")

    def __len__(self) -> int:
        return len(self.relaxation_rate)

    def __getitem__(self, index: Tensor) -> "MotionModels":
        """The models at `index` [P]; repeats are allowed."""
        return MotionModels(
            self.relaxation_rate[index], self.turn_rate[index], self.diffusion[index], self.initial_speed[index]
        )

    def scaled(self, step_s: float, speed_mps: float) -> "MotionModels":
        """The same models brought from units of steps and step lengths (speed times step) to seconds and metres."""
        return MotionModels(
            self.relaxation_rate / step_s,
            self.turn_rate / step_s,
            self.diffusion * speed_mps**2 / step_s,
            self.initial_speed * speed_mps,
        )


def constant_velocity(diffusion: list[float], initial_speed: float = 1.5) -> MotionModels:
    """Constant velocity with white acceleration noise."""
    zero = torch.zeros(len(diffusion), dtype=torch.float64)
    return MotionModels(zero, zero, torch.tensor(diffusion, dtype=torch.float64), zero + initial_speed)


def ornstein_uhlenbeck(relaxation: list[float], speed: list[float], turn_rate: list[float]) -> MotionModels:
    """All combinations of relaxation time, stationary speed an axis and turn rate; starts in its stationary law."""
    grid = torch.tensor(list(itertools.product(relaxation, speed, turn_rate)), dtype=torch.float64)
    time, sigma, turn = grid.unbind(-1)
    return MotionModels(1.0 / time, turn, 2.0 * sigma**2 / time, sigma)


def concatenate(*models: MotionModels) -> MotionModels:
    """One bank of several."""
    columns = ("relaxation_rate", "turn_rate", "diffusion", "initial_speed")
    return MotionModels(*(torch.cat([getattr(model, name) for model in models]) for name in columns))


def default_models() -> MotionModels:
    """The shipped bank in units of steps and step lengths: wide in speed and memory, so that any log finds its models."""
    turns = [sign * rate for rate in (0.035, 0.07, 0.14, 0.28, 0.57) for sign in (-1.0, 1.0)]
    return concatenate(
        constant_velocity([0.003**2, 0.01**2, 0.03**2, 0.1**2, 0.3**2, 1.0]),
        ornstein_uhlenbeck([1.0, 3.0, 10.0, 30.0, 100.0], [0.03, 0.1, 0.3, 0.7, 1.5], [0.0]),
        ornstein_uhlenbeck([0.3, 1.0], [2.5, 5.0], [0.0]),
        ornstein_uhlenbeck([30.0, 300.0], [0.7], turns),
    )


def transition(models: MotionModels, duration: Tensor) -> tuple[Tensor, Tensor]:
    """Transition matrix and process noise over a duration.

    Args:
        models: parameters [P].
        duration: [P, ...] non-negative, in the time unit of the models.

    Returns:
        Matrices [P, ..., 4, 4] for the state (x, y, vx, vy): the transition and the noise covariance.
    """
    extra = (...,) + (None,) * (duration.ndim - 1)
    rate = torch.complex(-models.relaxation_rate, models.turn_rate)[extra].expand(duration.shape)
    z = rate * duration
    growth = torch.exp(z)
    gain = duration * _phi1(z)
    noise_pp, noise_pv, noise_vv = _noise(models, rate, duration, z, extra)
    matrix = torch.zeros(*duration.shape, 4, 4, dtype=torch.float64)
    noise = torch.zeros_like(matrix)
    _put_complex(matrix, 0, 0, torch.ones_like(gain))
    _put_complex(matrix, 0, 2, gain)
    _put_complex(matrix, 2, 2, growth)
    _put_complex(noise, 0, 0, torch.complex(noise_pp, torch.zeros_like(noise_pp)))
    _put_complex(noise, 0, 2, noise_pv)
    _put_complex(noise, 2, 0, noise_pv.conj())
    _put_complex(noise, 2, 2, torch.complex(noise_vv, torch.zeros_like(noise_vv)))
    return matrix, noise


def _put_complex(matrix: Tensor, row: int, column: int, value: Tensor) -> None:
    # multiplication by a complex number as a 2 x 2 real block
    matrix[..., row, column] = matrix[..., row + 1, column + 1] = value.real
    matrix[..., row, column + 1] = -value.imag
    matrix[..., row + 1, column] = value.imag


def _phi1(z: Tensor) -> Tensor:
    """(exp(z) - 1) / z, by its series near zero."""
    series = 1.0 + z / 2 * (1.0 + z / 3 * (1.0 + z / 4 * (1.0 + z / 5 * (1.0 + z / 6))))
    is_small = z.abs() < 0.02
    safe = torch.where(is_small, torch.ones_like(z), z)
    return torch.where(is_small, series, (torch.exp(safe) - 1.0) / safe)


_NODES = torch.tensor([0.0694318442029737, 0.3300094782075719, 0.6699905217924281, 0.9305681557970263], dtype=torch.float64)
_WEIGHTS = torch.tensor([0.1739274225687269, 0.3260725774312731, 0.3260725774312731, 0.1739274225687269], dtype=torch.float64)


def _noise(
    models: MotionModels, rate: Tensor, duration: Tensor, z: Tensor, extra: tuple[EllipsisType | None, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """The integrals of the noise response (s phi1(a s), exp(a s)) over the duration, times the diffusion."""
    diffusion = models.diffusion[extra].expand(duration.shape)
    # Closed form, exact but cancelling for small |z|: there four Gauss-Legendre nodes are exact to 1e-13.
    is_small = z.abs() < 0.2
    a = torch.where(is_small, torch.ones_like(rate), rate)
    d = torch.where(is_small, torch.ones_like(duration), duration)
    twice_real = 2.0 * a.real
    vv_closed = d * _phi1(torch.complex(twice_real * d, torch.zeros_like(d))).real
    first = d * _phi1(a * d)
    pp_closed = (vv_closed - 2.0 * first.real + d) / (a.abs() ** 2)
    pv_closed = (torch.complex(vv_closed, torch.zeros_like(d)) - first.conj()) / a
    s = duration[..., None] * _NODES
    response = s * _phi1(rate[..., None] * s)
    velocity = torch.exp(rate[..., None] * s)
    weight = duration[..., None] * _WEIGHTS
    pp_small = (weight * response.abs() ** 2).sum(-1)
    pv_small = (weight * response * velocity.conj()).sum(-1)
    vv_small = (weight * velocity.abs() ** 2).sum(-1)
    return (
        diffusion * torch.where(is_small, pp_small, pp_closed),
        diffusion * torch.where(is_small, pv_small, pv_closed),
        diffusion * torch.where(is_small, vv_small, vv_closed),
    )
