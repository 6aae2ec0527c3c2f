"""A blueprint for Rerun, which draws the log and the side file without a script: what is shown where, and on which time line.

Rerun knows no foxglove.SceneUpdate, Grid and GeoJSON; it draws the clouds, voxels and fixes that stand beside them.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from cadence.errors import UsageError
from pipeline.takeaway.answer import Answer
from schemas import channels

_TIMELINE = "message_log_time"
"""What Rerun's importer calls the log time."""
_APPLICATION = "cadence"


def write_blueprint(answer: Answer, path: Path) -> None:
    """Write the blueprint; `UsageError` where rerun-sdk (the extra `viewer`) is not installed."""
    try:
        rrb: Any = importlib.import_module("rerun.blueprint")
    except ImportError as error:
        raise UsageError("--to rerun: needs rerun-sdk, which is not installed; pip install 'rerun-sdk>=0.23'") from error
    place = np.concatenate([track.position_m for track in answer.means()])
    low, high = np.percentile(place, [1, 99], axis=0)
    middle, extent = (*((low + high) / 2).tolist(), 0.0), max(float((high - low).max()), 1.0)
    eye = rrb.EyeControls3D(
        position=(middle[0], middle[1] - 0.4 * extent, 0.9 * extent), look_target=middle, eye_up=(0.0, 0.0, 1.0)
    )
    views = [
        rrb.Spatial3DView(
            name="hypotheses", origin="/", contents=["/**"], eye_controls=eye, line_grid=False,
            spatial_information=rrb.SpatialInformation(target_frame=answer.frame.frame_id),
        )
    ]  # fmt: skip
    if answer.frame.is_georeferenced:
        views.append(rrb.MapView(name="map", origin="/", contents=[channels.FIXES.topic, "/cadence/detection_fix/**"]))
    panels = (rrb.TimePanel(timeline=_TIMELINE), rrb.SelectionPanel(expanded=False))
    rrb.Blueprint(rrb.Horizontal(*views), *panels, collapse_panels=False).save(_APPLICATION, str(path))
