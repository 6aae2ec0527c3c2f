"""What `benchmarks.height` found, as a section of its page."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from benchmarks import publishing
from benchmarks.publishing import Measurement
from pipeline.logs.reader import open_log
from schemas.channels import SCENE

OWN, RIVALS = "height", ("linear", "cv")
PARTS = ("past", "between", "future")


@dataclass(frozen=True)
class Row:
    """One estimator on one log at one rate, over all seeds; `ratio` is the bank's score over this one's."""

    log: str
    detections_percent: int
    part: str
    estimator: str
    score_m: float
    score_m_low: float
    score_m_high: float
    ratio: float
    ratio_low: float
    ratio_high: float
    coverage_90: float
    num_cells: int
    num_groups: int
    seeds: str


def section(measured: Measurement) -> str:
    """The bank's score, ratios to both rivals, and coverage."""
    lines, num_ahead, num_behind = [], 0, 0
    for own in measured.rows(estimator=OWN):
        cells = [f"{own['log']}, {own['detections_percent']} %, {own['part']}", publishing.interval(own, "score_m")]
        for rival in RIVALS:
            (row,) = measured.rows(
                log=own["log"], detections_percent=own["detections_percent"], part=own["part"], estimator=rival
            )
            cells.append(publishing.interval(row, "ratio", ".2f"))
            num_ahead += row["ratio_high"] < 1.0
            num_behind += row["ratio_low"] > 1.0
        if own["part"] != "past":  # "between" is of it
            lines.append([*cells, f"{100 * own['coverage_90']:.0f} %"])
    heads = ["log, detections, part", "CRPS of height, m", "over linear's", "over constant velocity's", "in 90 %"]
    num = len(measured.rows(estimator=OWN)) * len(RIVALS)
    text = (
        f"Ahead with the whole interval in {num_ahead} of {num} comparisons, behind in {num_behind}; the others are ties. "
        "Intervals of 95 % over aircraft (`aircraft`) or flights (`adsb`)."
    )
    return f"{text}\n\n{publishing.table(heads, lines)}"


def draw_scene(side_file: Path, number: int, path: Path) -> None:
    """The points of one scene of a side file as they stand there, in a 3-D axis: what the 3D panel of a viewer shows."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    messages = [raw.data for raw in open_log(side_file).messages({SCENE.topic})]
    figure = plt.figure(figsize=(9, 6), layout="constrained")
    axis = figure.add_subplot(projection="3d")
    for entity in SceneUpdate.FromString(messages[number]).entities:
        for line in entity.lines:
            x, y, z = np.array([(point.x, point.y, point.z) for point in line.points]).T
            color = (line.color.r, line.color.g, line.color.b, line.color.a)
            axis.plot(x / 1e3, y / 1e3, z, color=color, linewidth=0.5 * line.thickness)
        centres = np.array(
            [(ball.pose.position.x / 1e3, ball.pose.position.y / 1e3, ball.pose.position.z) for ball in entity.spheres]
        )
        if len(centres):
            axis.scatter(*centres.T, color="black", s=14, depthshade=False)
    axis.set(xlabel="east, km", ylabel="north, km", zlabel="height, m")
    axis.view_init(18, -60)
    figure.savefig(path, dpi=100)
    plt.close(figure)
