"""Does a checkpoint fit a log? It is tested on detections of the log that it is not shown, before anything is drawn with it.

A checkpoint that learned a place knows nothing of any other, and says so with confidence: its hypotheses of a strange log look
like those of its own. What was detected after a window's origin tells them apart, without any truth.
"""

import dataclasses
import math
from dataclasses import dataclass

from cadence.bank.bank import Bank
from cadence.bank.hindsight import LEAST_TESTS, NUM_SAMPLES, at_detections, num_tests, scores_in_hindsight
from cadence.metrics import coverage
from cadence.types import Detections, Estimator, WindowBatch
from pipeline.estimators.fitting import FittingData
from pipeline.windows import MissionWindows

_NUM_ROWS = 12
"""So few tracks are drawn: on 15 logs of its own place `prison` had .05 to .53 of the bank's error, on others 1.4 and more."""
_LEAST_ERRORS = 2.0
_LEAST_IN_90 = 0.5


@dataclass(frozen=True)
class FitTest:
    """How well a checkpoint foresees later detections of a log.

    num_detections  so many were compared
    ratio           its energy score over that of the bank of motion models, which every log is fitted with
    num_errors      by how many standard errors of the paired difference it is worse than the bank; negative: better
    in_90           share of the detections inside its 90 % region
    """

    num_detections: int
    ratio: float
    num_errors: float
    in_90: float

    @property
    def is_misfit(self) -> bool:
        """Whether the bank, which knows no place, is better: certainly, or where most detections lie outside the region."""
        return self.ratio > 1.0 and (self.num_errors > _LEAST_ERRORS or self.in_90 < _LEAST_IN_90)

    def __str__(self) -> str:
        return (
            f"{100.0 * self.in_90:.0f} % of {self.num_detections} later detections lie in its 90 % region, and its error is "
            f"{self.ratio:.3g} times that of motion alone"
        )


def fit_test(estimator: Estimator, data: FittingData, located: MissionWindows) -> FitTest | None:
    """The test on later detections of some windows; None where there are too few to tell.

    Args:
        estimator: as it would draw the log.
        data: the detections of the log.
        located: its windows, with all that is known beside the detections.
    """
    windows, later = dataclasses.replace(data, windows=located).later_known(_NUM_ROWS)
    num = num_tests(windows, later) if windows.num_windows else 0
    if num < LEAST_TESTS:
        return None
    bank = Bank().fit(data.tracks, data.grid.step_s)
    return _compared(estimator, bank, windows, later, num)


def _compared(estimator: Estimator, bank: Bank, windows: WindowBatch, later: Detections, num: int) -> FitTest:
    drawn = estimator.sample(windows, NUM_SAMPLES)
    own = scores_in_hindsight(drawn.position_m, windows, later)
    other = scores_in_hindsight(bank.sample(windows, NUM_SAMPLES).position_m, windows, later)
    worse = own - other
    error = float(worse.std()) / math.sqrt(len(worse)) if len(worse) > 1 else math.inf
    foreseen, is_used = at_detections(drawn.position_m, windows, later)
    inside = coverage(foreseen, drawn.weight, later.position_m, (0.9,))[0]
    return FitTest(
        num,
        float(own.mean() / other.mean().clamp_min(1e-12)),
        float(worse.mean()) / error if error > 0.0 else math.inf * float(worse.mean().sign()),
        float(inside[is_used].mean()),
    )
