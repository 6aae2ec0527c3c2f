"""Motion models as one linear stochastic differential equation with three parameters.

With the plane read as complex numbers, position p and velocity v follow

    dp = v dt,    dv = (-1/relaxation + i * turn_rate) v dt + noise of intensity `diffusion`

which is constant velocity for no relaxation and no turn, integrated Ornstein-Uhlenbeck with relaxation, and a coordinated
turn with a turn rate (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", ch. 6 and 11).

A target that stays about a place has a centre c besides, which is constant and unknown, and is drawn back to it:

    dp = v dt,    dv = (-1/relaxation v - (speed/range)^2 (p - c)) dt + noise,    dc = 0

a damped oscillator whose stationary law has the deviations `range` of position and `speed` of velocity (the OUF process of
Fleming, Calabrese et al., "From fine-scale foraging to home ranges", American Naturalist 183, 2014).
Everything is closed form, so that detections may lie at any times.
"""

import itertools
from dataclasses import dataclass
from types import EllipsisType

import torch
from torch import Tensor

from cadence.bank.oscillator import NODES, WEIGHTS, oscillator


@dataclass(frozen=True, eq=False)
class MotionModels:
    """C motion models, float64 tensors [C] in consistent units (seconds and metres, or steps and step lengths).

    relaxation_rate  1/s, zero for constant velocity
    turn_rate        rad/s, positive to the left
    diffusion        m^2/s^3 and axis: intensity of the acceleration noise
    initial_speed    m/s and axis: standard deviation of the velocity where nothing is known yet
    home_range       m and axis: standard deviation about the centre that a target is drawn back to; infinite without one
    num_states       length of the state: 4, or 6 in a bank where any model has a home
    """

    relaxation_rate: Tensor
    turn_rate: Tensor
    diffusion: Tensor
    initial_speed: Tensor
    home_range: Tensor
    num_states: int = 4

    def __post_init__(self) -> None:
        shapes = {tuple(value.shape) for value in self.columns}
        if len(shapes) != 1 or self.relaxation_rate.ndim != 1:
            raise ValueError(f"MotionModels: parameters must share one shape [C], got {sorted(shapes)}")

    def __len__(self) -> int:
        return len(self.relaxation_rate)

    def __getitem__(self, index: Tensor) -> "MotionModels":
        """The models at `index` [P]; repeats are allowed."""
        relaxation, turn, diffusion, speed, home = (value[index] for value in self.columns)
        return MotionModels(relaxation, turn, diffusion, speed, home, self.num_states)

    @property
    def columns(self) -> tuple[Tensor, ...]:
        """The five parameters."""
        return self.relaxation_rate, self.turn_rate, self.diffusion, self.initial_speed, self.home_range

    @property
    def has_home(self) -> Tensor:
        """Which models draw a target back to a centre [C]."""
        return self.home_range.isfinite()

    def scaled(self, step_s: float, speed_mps: float) -> "MotionModels":
        """The same models brought from units of steps and step lengths (speed times step) to seconds and metres."""
        return MotionModels(
            self.relaxation_rate / step_s,
            self.turn_rate / step_s,
            self.diffusion * speed_mps**2 / step_s,
            self.initial_speed * speed_mps,
            self.home_range * speed_mps * step_s,
            self.num_states,
        )


def constant_velocity(diffusion: list[float], initial_speed: float = 1.5) -> MotionModels:
    """Constant velocity with white acceleration noise."""
    zero = torch.zeros(len(diffusion), dtype=torch.float64)
    return MotionModels(zero, zero, torch.tensor(diffusion, dtype=torch.float64), zero + initial_speed, zero + torch.inf)


def ornstein_uhlenbeck(relaxation: list[float], speed: list[float], turn_rate: list[float]) -> MotionModels:
    """All combinations of relaxation time, stationary speed an axis and turn rate; starts in its stationary law."""
    grid = torch.tensor(list(itertools.product(relaxation, speed, turn_rate)), dtype=torch.float64)
    time, sigma, turn = grid.unbind(-1)
    return MotionModels(1.0 / time, turn, 2.0 * sigma**2 / time, sigma, torch.full_like(time, torch.inf))


def home_ranges(relaxation: list[float], speed: list[float], size: list[float]) -> MotionModels:
    """All combinations of relaxation time, stationary speed and stationary distance from the centre, each an axis."""
    grid = torch.tensor(list(itertools.product(relaxation, speed, size)), dtype=torch.float64)
    time, sigma, distance = grid.unbind(-1)
    return MotionModels(1.0 / time, torch.zeros_like(time), 2.0 * sigma**2 / time, sigma, distance, num_states=6)


def concatenate(*models: MotionModels) -> MotionModels:
    """One bank of several."""
    relaxation, turn, diffusion, speed, home = map(torch.cat, zip(*(model.columns for model in models), strict=True))
    return MotionModels(relaxation, turn, diffusion, speed, home, max(model.num_states for model in models))


def default_models() -> MotionModels:
    """The shipped bank in units of steps and step lengths: wide in speed and memory, so that any log finds its models."""
    turns = [sign * rate for rate in (0.035, 0.07, 0.14, 0.28, 0.57) for sign in (-1.0, 1.0)]
    return concatenate(
        constant_velocity([0.003**2, 0.01**2, 0.03**2, 0.1**2, 0.3**2, 1.0]),
        ornstein_uhlenbeck([1.0, 3.0, 10.0, 30.0, 100.0], [0.03, 0.1, 0.3, 0.7, 1.5], [0.0]),
        ornstein_uhlenbeck([0.3, 1.0], [2.5, 5.0], [0.0]),
        ornstein_uhlenbeck([30.0, 300.0], [0.7], turns),
        home_ranges([2.0, 10.0], [0.5, 1.0], [1.0, 3.0, 10.0, 30.0]),
        # the way between detections far apart is shorter than the one flown: who circles is faster than the log's usual speed
        home_ranges([0.7, 2.0, 10.0], [2.0], [1.0, 3.0, 10.0, 30.0]),
    )


def transition(models: MotionModels, duration: Tensor) -> tuple[Tensor, Tensor]:
    """Transition matrix and process noise over a duration.

    Args:
        models: parameters [P].
        duration: [P, ...] non-negative, in the time unit of the models.

    Returns:
        Matrices [P, ..., S, S] for the state (x, y, vx, vy), of models with a home for (x, y, vx, vy, centre x, centre y): the
        transition and the noise covariance. Where some models have a home the state of all has a centre.
    """
    extra = (...,) + (None,) * (duration.ndim - 1)
    rate = torch.complex(-models.relaxation_rate, models.turn_rate)[extra].expand(duration.shape)
    z = rate * duration
    growth = torch.exp(z)
    gain = duration * _phi1(z)
    noise_pp, noise_pv, noise_vv = _noise(models, rate, duration, z, extra)
    size = models.num_states
    matrix = torch.zeros(*duration.shape, size, size, dtype=torch.float64)
    noise = torch.zeros_like(matrix)
    _put_complex(matrix, 0, 0, torch.ones_like(gain))
    _put_complex(matrix, 0, 2, gain)
    _put_complex(matrix, 2, 2, growth)
    _put_complex(noise, 0, 0, torch.complex(noise_pp, torch.zeros_like(noise_pp)))
    _put_complex(noise, 0, 2, noise_pv)
    _put_complex(noise, 2, 0, noise_pv.conj())
    _put_complex(noise, 2, 2, torch.complex(noise_vv, torch.zeros_like(noise_vv)))
    if size > 4:
        _put_complex(matrix, 4, 4, torch.ones_like(gain))
        home = models.has_home
        matrix[home], noise[home] = _about_home(models[home], duration[home], extra)
    return matrix, noise


def _about_home(models: MotionModels, duration: Tensor, extra: tuple[EllipsisType | None, ...]) -> tuple[Tensor, Tensor]:
    columns = (models.relaxation_rate, models.initial_speed, models.home_range)
    relaxation, speed, home = (column[extra].expand(duration.shape) for column in columns)
    return oscillator(relaxation, speed, home, duration)


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
    s = duration[..., None] * NODES
    response = s * _phi1(rate[..., None] * s)
    velocity = torch.exp(rate[..., None] * s)
    weight = duration[..., None] * WEIGHTS
    pp_small = (weight * response.abs() ** 2).sum(-1)
    pv_small = (weight * response * velocity.conj()).sum(-1)
    vv_small = (weight * velocity.abs() ** 2).sum(-1)
    return (
        diffusion * torch.where(is_small, pp_small, pp_closed),
        diffusion * torch.where(is_small, pv_small, pv_closed),
        diffusion * torch.where(is_small, vv_small, vv_closed),
    )
