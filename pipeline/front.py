"""The front door for Python: run logs, open what came out as numpy and Arrow, score it; settings as in TOML files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa

from cadence.constraints.obstacles import Obstacles
from cadence.errors import InputError
from pipeline.ask.answers import Answer, answers
from pipeline.ask.known import Known, open_known
from pipeline.ask.question import Question
from pipeline.batch.config import RunConfig
from pipeline.batch.outcome import LogOutcome
from pipeline.batch.run import run
from pipeline.config import read_settings
from pipeline.evaluate.stage import EvaluateConfig, evaluate
from pipeline.missions import is_mission_directory
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacles
from pipeline.progress import Progress
from pipeline.results import MissionHypotheses, read_hypothesis_tables
from pipeline.tables import Frame, read_table

Settings = Mapping[str, Any]
"""Tables and keys as in a configuration file (docs/configuration.md): `{"infer": {"num_hypotheses": 50}}`."""


@dataclass(frozen=True)
class Mission:
    """A mission directory. What it holds is read when it is asked for; `InputError` where a stage has not written it.

    path  of the directory
    """

    path: Path

    @cached_property
    def hypotheses(self) -> MissionHypotheses:
        """All windows, each with the joint hypotheses of all agents as numpy views, and the frame of their positions."""
        return read_hypothesis_tables(self.path)

    @cached_property
    def obstacles(self) -> Obstacles:
        """What hypotheses keep out of, in the mission frame."""
        return read_obstacles(self.path / OBSTACLES_NAME)

    @property
    def frame(self) -> Frame:
        """The mission frame: x east, y north, metres about its datum."""
        return read_table(self.path / "detections.parquet", "detections")[1]

    def ask(self, question: Question) -> tuple[Answer, ...]:
        """What the mission hypotheses say to a question, an answer for each agent or pair; see `cadence ask --help`."""
        return answers(self._known if question.as_of is None else open_known(self.path, question.as_of), question)

    @cached_property
    def _known(self) -> Known:
        return open_known(self.path)

    def table(self, name: str) -> pa.Table:
        """An Arrow table (docs/formats.md): detections, truth, poses, hypotheses, windows, associations or labels."""
        return read_table(self.path / f"{name}.parquet", name)[0]


def run_logs(
    logs: str | Path | Sequence[str | Path], out: str | Path, settings: Settings | None = None, num_workers: int = 0
) -> tuple[LogOutcome, ...]:
    """Run all stages on every mission among `logs`, as `cadence run` does; what is done already is not done again.

    Args:
        logs: files, folders, patterns or URLs.
        out: folder or URL of the mission directories.
        settings: of the stages; `ConfigError` for what is not a setting.
        num_workers: processes; 0 runs here.

    Returns:
        What became of each mission. Failures are in the outcomes (`status`, `message`), not raised.
    """
    several = [logs] if isinstance(logs, str | Path) else logs
    config = read_settings(RunConfig, settings or {}, "")
    return run([str(log) for log in several], str(out), config, Progress(quiet=True), num_workers=num_workers)


def open_mission(directory: str | Path) -> Mission:
    """The mission in a directory that `run_logs` or `cadence run` has written; `InputError` where it is none."""
    path = Path(directory)
    if not is_mission_directory(path):
        raise InputError(f"{path}: no mission directory; give a folder that cadence run has written for one log")
    return Mission(path)


def evaluate_mission(directory: str | Path, settings: Settings | None = None) -> list[dict[str, Any]]:
    """Score a mission against its truth, beside rivals; scores.csv, .json and .md are written into it.

    Args:
        directory: of the mission.
        settings: of the table [evaluate].

    Returns:
        The headline: rows with estimator, part, metric and value; scores.csv holds all, with intervals.
    """
    config = read_settings(EvaluateConfig, settings or {}, "evaluate")
    found: list[dict[str, Any]] = list(evaluate(Path(directory), config, Progress(quiet=True)).summary["scores"])
    return found
