from .ask.answers import Answer
from .ask.question import Question
from .estimators.presets import load_forecaster
from .front import Mission, evaluate_mission, open_mission, run_logs
from .results import AgentHypotheses, MissionHypotheses, WindowHypotheses

__all__ = [
    "AgentHypotheses",
    "Answer",
    "Mission",
    "MissionHypotheses",
    "Question",
    "WindowHypotheses",
    "evaluate_mission",
    "load_forecaster",
    "open_mission",
    "run_logs",
]
