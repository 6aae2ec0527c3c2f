from .bank.bank import Bank
from .baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from .baselines.library import TrajectoryLibrary
from .constraints.obstacles import Obstacles
from .diffusion.absolute import AbsoluteModel
from .diffusion.general import GeneralModel
from .diffusion.place import PlaceModel
from .diffusion.sampler import sample_ddim, sample_ddpm, sample_dpmpp_2m, sample_rotation
from .diffusion.settings import GuidanceConfig
from .errors import CadenceError
from .evidence.estimator import WithEvidence
from .metrics import ade, coverage, energy_score, mean_error, min_ade
from .recordings import Recordings, cut_windows
from .training.loop import OptimiserConfig
from .training.place import place_config, train_place
from .types import Context, Detections, Estimator, Evidence, HypothesisSet, Tracks, WindowBatch

__all__ = [
    "AbsoluteModel",
    "Bank",
    "CadenceError",
    "ConstantVelocityKalman",
    "Context",
    "Detections",
    "Estimator",
    "Evidence",
    "GeneralModel",
    "GuidanceConfig",
    "HypothesisSet",
    "Obstacles",
    "OptimiserConfig",
    "OrnsteinUhlenbeckKalman",
    "PlaceModel",
    "Recordings",
    "Tracks",
    "TrajectoryLibrary",
    "WindowBatch",
    "WithEvidence",
    "ade",
    "coverage",
    "cut_windows",
    "energy_score",
    "mean_error",
    "min_ade",
    "place_config",
    "sample_ddim",
    "sample_ddpm",
    "sample_dpmpp_2m",
    "sample_rotation",
    "train_place",
]
