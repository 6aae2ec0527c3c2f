"""What belongs to a call of the estimators: settings, read long before anything is drawn, so that they cost no torch."""

from dataclasses import dataclass
from typing import Literal

SamplerName = Literal["rotation", "ddim", "dpmpp"]
Inpainting = Literal["none", "overwrite", "noise_matched", "smoother"]
"""How detections are put in.

overwrite      the paper's: after each step the known cells are set to the detections, clean whatever the noise level
noise_matched  set to the detections with the noise of the current level (Lugmayr et al., "RePaint", CVPR 2022)
smoother       the clean estimate is moved onto the detections, its neighbours with it: no jumps, covariances count
"""


@dataclass(frozen=True)
class GuidanceConfig:
    """How constraints act on hypotheses.

    mode           "clean" guides while sampling and repairs at the end; "repair" only repairs; "none" ignores constraints;
                   of the place preset only "none" counts (infer.place says how it guides), and the paper preset has infer.paper
    margin_m       distance to keep from obstacles
    max_speed_mps  a speed that the target cannot exceed; None = no limit
    max_acceleration_mps2  an acceleration, in any direction, that it cannot exceed; of the general preset
    max_turn_rate_dps  a rate of turn in degrees a second that it cannot exceed while it moves, which means faster than a
                   twentieth of what is typical of the log; of the general preset
    """

    mode: Literal["clean", "repair", "none"] = "clean"
    margin_m: float = 0.0
    max_speed_mps: float | None = None
    max_acceleration_mps2: float | None = None
    max_turn_rate_dps: float | None = None

    def __post_init__(self) -> None:
        limits = {name: getattr(self, name) for name in ("max_speed_mps", "max_acceleration_mps2", "max_turn_rate_dps")}
        wrong = [name for name, value in limits.items() if value is not None and not value > 0]
        if self.margin_m < 0 or wrong:
            raise ValueError(f"{wrong[0]} must be positive" if wrong else "margin_m must not be negative")


@dataclass(frozen=True)
class AbsoluteSampling:
    """What belongs to a call.

    sampler        "ddpm" takes all steps of the schedule, as in the paper; "ddim" and "dpmpp" take fewer
    num_steps      how many those take
    inpainting     see `cadence.diffusion.inpainting`; "overwrite" is the paper's
    length_steps, amplitude  of the smoother's kernel; the amplitude in normalised units
    floor          standard deviation added to every detection there, normalised: exact ones close in time may disagree a little
    guidance       "paper": Adam on the mean (algorithm 1; only with ddpm), "clean": on the clean estimate
    max_speed_mps  speed limit for the guidance "clean"
    margin_m       distance from obstacles that it asks for
    learning_rate, iterations  of the paper's guidance
    chunk          trajectories computed at once
    encode_each_step  read the detections again for every sample and step, as the authors' code does: for benchmarks only
    """

    sampler: Literal["ddpm", "ddim", "dpmpp"] = "ddpm"
    num_steps: int = 10
    inpainting: Inpainting = "smoother"
    length_steps: float = 8.0
    amplitude: float = 0.5
    floor: float = 1e-4
    guidance: Literal["none", "paper", "clean"] = "none"
    max_speed_mps: float | None = None
    margin_m: float = 0.0
    learning_rate: float = 1e-2
    iterations: int = 8
    chunk: int = 2048
    encode_each_step: bool = False

    def __post_init__(self) -> None:
        if self.guidance == "paper" and self.sampler != "ddpm":
            raise ValueError(f"guidance 'paper' moves the mean of a ddpm step; sampler is {self.sampler!r}")
        if min(self.num_steps, self.chunk) < 1 or not min(self.length_steps, self.amplitude) > 0 or self.floor < 0:
            raise ValueError("num_steps, chunk, length_steps and amplitude must be positive, floor not negative")


@dataclass(frozen=True)
class PlaceSampling:
    """How a place model is sampled.

    sampler     "few": the few steps that the weights were tuned for, which take no other; "ddpm", "ddim", "dpmpp": any number
                for weights that were trained by diffusion alone; "auto": few where the weights are tuned, else dpmpp
    num_steps   of ddpm, ddim and dpmpp
    is_antithetic  hypotheses come in pairs that begin with mirrored noise: each is still a draw of the distribution, and a few
                stand for it better than as many independent ones. Not with ddpm, which adds noise at every step
    guidance    away from obstacles: "final" moves the finished track, "clean" every clean estimate, "paper" every mean
                (algorithm 1; with ddpm), "none". Moved while it is still uncertain, a track becomes another one; the finished
                track changes least, and leaves little to repair, which is slow
    is_repaired lead what still crosses an obstacle around it at the end
    margin_m    distance that is kept from obstacles
    learning_rate, iterations, step_weight  of the paper's guidance; the last is the weight of the mean step length, which is
                smallest for targets that do not move
    precision   of the network's layers; "bfloat16" is quicker on processors that have it, at a rounding that no score shows
    chunk       tracks computed at once
    encode_each_step  read the detections again for every hypothesis and step, as the authors' code does: for benchmarks only
    """

    sampler: Literal["auto", "few", "ddpm", "ddim", "dpmpp"] = "auto"
    num_steps: int = 6
    is_antithetic: bool = True
    guidance: Literal["none", "final", "clean", "paper"] = "final"
    is_repaired: bool = True
    margin_m: float = 0.0
    learning_rate: float = 1e-2
    iterations: int = 8
    step_weight: float = 50.0
    precision: Literal["float32", "bfloat16"] = "float32"
    chunk: int = 1024
    encode_each_step: bool = False

    def __post_init__(self) -> None:
        if self.guidance == "paper" and self.sampler != "ddpm":
            raise ValueError(f"guidance 'paper' moves the mean of a ddpm step; sampler is {self.sampler!r}")
        if min(self.num_steps, self.chunk, self.iterations) < 1 or min(self.margin_m, self.step_weight) < 0:
            raise ValueError("num_steps, chunk and iterations must be at least 1, margin_m and step_weight not negative")
