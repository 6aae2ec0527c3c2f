"""Whose heights are nearest to those of real aircraft seen now and then?

Aircraft of ../shared/data are thinned to bursts of detections like those of benchmarks.real_logs; the bank of height and two
rivals are fitted to the heights of the detections alone, with the same noise, and scored at every step against the whole
track. Rivals take a plane both of whose axes are height: linear interpolation with a law of its errors by gap, and a
constant-velocity smoother, both fitted, the latter tuned by withheld detections. One JSON file per setting and estimator in the
work folder: a killed run goes on where it was.

    python -m benchmarks.height --publish docs
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from torch import Tensor

from benchmarks import publishing
from benchmarks.height_page import PARTS, RIVALS, Row, draw_scene, section
from benchmarks.publishing import Measurement
from benchmarks.real_logs import CASES, DATA, RATES, Setting, evenly_spread, prepare
from cadence import metrics
from cadence.baselines.interpolation import LinearInterpolation
from cadence.baselines.kalman import ConstantVelocityKalman
from cadence.metrics import bootstrap_ratio
from pipeline.estimators.fitting import FittingData
from pipeline.files import write_atomic
from pipeline.grids import GridConfig, plan_grid
from pipeline.progress import Progress
from pipeline.scoring.case import default_truth_gap_s
from pipeline.scoring.scores import detection_distances
from pipeline.tables import read_table
from pipeline.windows import MissionWindows, build_windows, truth_on_grid

WORK = Path("out/benchmarks/height")
OWN = "height"
RESULT_VERSION = 1
_NUM_COVERED = 4000
"""Cells of a part whose regions are looked at: evenly spread."""

Draw = Callable[[Tensor, int], Tensor]
"""Heights [b, K, A, T] of the windows with the indices [b]."""
Result = dict[str, dict[str, dict[str, list[float]]]]
"""{part: {group: [sum of scores, cells, sum of coverage, cells looked at]}}"""


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """One thinned recording: windows with heights, the same as a plane, and the truth [B, A, T]."""

    setting: Setting
    data: FittingData
    windows: MissionWindows
    flat: FittingData
    flat_windows: MissionWindows
    truth_m: Tensor
    is_known: Tensor


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing, print the table, and publish it where asked to."""
    options = _parser().parse_args(arguments)
    if not DATA.is_dir():
        print(f"skipped: {DATA} is not here")
        return 0
    settings = [
        Setting(log, case, rate, seed)
        for log in options.logs for case in CASES[log] for rate in options.rates for seed in options.seeds
    ]  # fmt: skip
    for setting in settings:
        run_setting(setting, options, Progress(quiet=options.quiet))
    rows = table(settings, options)
    if options.picture is not None:
        draw_scene(options.picture, options.scene, (options.publish or options.work) / "images" / "height.png")
    facts = publishing.facts_of("height", arguments) | {"num_hypotheses": options.hypotheses}
    measured = Measurement("height", facts, {"height": [dataclasses.asdict(row) for row in rows]})
    print(publishing.as_csv(measured.rows()), end="")
    if options.publish is not None:
        publishing.publish(measured, section, options.publish)
    return 0


def run_setting(setting: Setting, options: argparse.Namespace, progress: Progress) -> None:
    """Score the estimators that have no result yet for one thinned log."""
    missing = [name for name in (OWN, *RIVALS) if not _path(options.work, setting, name, options.hypotheses).is_file()]
    if not missing:
        return
    problem = read_problem(setting, options.work / setting.folder, progress)
    for name in missing:
        found = scored(problem, draw_of(name, problem), options.hypotheses, options.most_tracks)
        write_atomic(_path(options.work, setting, name, options.hypotheses), json.dumps(found))
        progress.note(f"{setting.folder}: {name}")


def read_problem(setting: Setting, directory: Path, progress: Progress) -> Problem:
    """Thin the log and cut its windows."""
    prepare(setting, directory, progress)
    detections, _ = read_table(directory / "detections.parquet", "detections")
    truth, _ = read_table(directory / "truth.parquet", "truth")
    detections, truth = (one.filter(pc.is_valid(one["z_m"])) for one in (detections, truth))
    flat, flat_truth = as_plane(detections), as_plane(truth)
    case = setting.case
    grid = plan_grid(detections, GridConfig(step_s=case.step_s(setting.rate), stride_steps=case.stride_steps))
    windows, flat_windows = (build_windows(one, grid, setting.seed) for one in (detections, flat))
    truth_m, is_known = truth_on_grid(flat_truth, flat_windows, default_truth_gap_s(truth, grid.step_s))
    base_m = torch.from_numpy(flat_windows.datum_m[:, 0])[:, None, None]
    data, flat_data = FittingData.of(detections, grid, windows), FittingData.of(flat, grid, flat_windows)
    return Problem(setting, data, windows, flat_data, flat_windows, truth_m[..., 0] + base_m, is_known)


def as_plane(table: pa.Table) -> pa.Table:
    """A table whose x and y are both z: what estimators of a plane are shown of heights."""
    columns = {"x_m": table["z_m"], "y_m": table["z_m"]}
    if "cov_zz_m2" in table.column_names:
        variance = pc.fill_null(table["cov_zz_m2"], 0.0)
        columns |= {"cov_xx_m2": variance, "cov_yy_m2": variance, "cov_xy_m2": pc.multiply(variance, 0.0)}
        table = table.drop_columns(["cov_zz_m2"])
    for name, column in columns.items():
        index = table.schema.get_field_index(name)
        table = table.set_column(index, table.schema.field(index), column)
    return table


def draw_of(name: str, problem: Problem) -> Draw:
    """A fitted estimator's heights."""
    if name == OWN:
        bank = problem.data.fitted_heights()
        return lambda index, num: bank.sample(problem.windows.batch[index], num)
    data, datum_m = problem.flat, torch.from_numpy(problem.flat_windows.datum_m)
    if name == "linear":
        fitted = LinearInterpolation().fit(data.tracks)
        draw = fitted.sample
    else:
        draw = ConstantVelocityKalman().fit(data.tracks, data.grid.step_s).tuned(data.tests).sample

    def heights(index: Tensor, num: int) -> Tensor:
        drawn = draw(problem.flat_windows.batch[index], num).position_m[..., 0].double()
        return drawn + datum_m[index, 0][:, None, None, None]

    return heights


def scored(problem: Problem, draw: Draw, num_hypotheses: int, most_tracks: int) -> Result:
    """Sums of CRPS and coverage by part and group."""
    index = evenly_spread(problem.windows.batch.is_active, most_tracks)
    batch, truth_m = problem.windows.batch[index], problem.truth_m[index]
    height_m = torch.cat([draw(part, num_hypotheses) for part in index.split(32)])
    age, gap, _ = detection_distances(batch)
    is_scored = problem.is_known[index] & age.isfinite()
    is_future = (batch.time_s > 0.5 * batch.step_s).expand_as(is_scored)
    masks = (is_scored & ~is_future, is_scored & ~is_future & gap.isfinite(), is_scored & is_future)
    group = _groups(problem, is_scored)
    found: Result = {}
    for part, mask in zip(PARTS, masks, strict=True):
        window, agent, step = mask.nonzero(as_tuple=True)
        at = height_m[window, :, agent, step][:, :, None, None, None]
        weight = torch.full(at.shape[:2], 1.0 / num_hypotheses, dtype=torch.float64)
        truth = truth_m[window, agent, step][:, None, None, None]
        score = metrics.energy_score(at, weight, truth).flatten().numpy()
        some = np.unique(np.linspace(0, len(window) - 1, min(len(window), _NUM_COVERED)).round().astype(int))
        covered = metrics.coverage(at[some], weight[some], truth[some], (0.9,)).flatten().numpy()
        names = group[window.numpy(), agent.numpy()]
        found[part] = {
            str(name): [
                float(score[names == name].sum()), int((names == name).sum()),
                float(covered[names[some] == name].sum()), int((names[some] == name).sum()),
            ]
            for name in np.unique(names)
        }  # fmt: skip
    return found


def _groups(problem: Problem, is_scored: Tensor) -> np.ndarray:
    """Bootstrap group of every window and agent: the agent, or the flight of a log of one."""
    names = np.array(problem.windows.agent_ids if problem.setting.log == "aircraft" else [problem.setting.case.name])
    return np.broadcast_to(names[None, :], is_scored.shape[:2])


def table(settings: Sequence[Setting], options: argparse.Namespace) -> list[Row]:
    """Means over all seeds, ratios to each rival, and how often the region of 90 % holds the truth."""
    rows = []
    for log, rate in dict.fromkeys((setting.log, setting.rate) for setting in settings):
        here = [setting for setting in settings if (setting.log, setting.rate) == (log, rate)]
        for part in PARTS:
            pooled = {name: _pooled(here, name, part, options) for name in (OWN, *RIVALS)}
            rng = np.random.default_rng(0)
            groups = list(pooled[OWN])
            total = {name: [found[group][0] for group in groups] for name, found in pooled.items()}
            count = [pooled[OWN][group][1] for group in groups]
            for name in (OWN, *RIVALS):
                covered = np.array(list(pooled[name].values()))[:, 2:].sum(0)
                ratio = bootstrap_ratio(total[OWN], total[name], groups, rng)
                mean = bootstrap_ratio(total[name], count, groups, rng)
                rows.append(
                    Row(
                        log,
                        round(100 * rate),
                        part,
                        name,
                        mean.value,
                        mean.low,
                        mean.high,
                        ratio.value,
                        ratio.low,
                        ratio.high,
                        float(covered[0] / covered[1]),
                        int(sum(count)),
                        len(groups),
                        " ".join(map(str, options.seeds)),
                    )
                )
    return rows


def _pooled(settings: Sequence[Setting], name: str, part: str, options: argparse.Namespace) -> Mapping[str, list[float]]:
    found: dict[str, list[float]] = {}
    for setting in settings:
        result = json.loads(_path(options.work, setting, name, options.hypotheses).read_text())
        for group, sums in result[part].items():
            found[group] = [a + b for a, b in zip(found.get(group, [0.0] * 4), sums, strict=True)]
    return found


def _path(work: Path, setting: Setting, name: str, num_hypotheses: int) -> Path:
    return work / setting.folder / f"{name}_v{RESULT_VERSION}_{num_hypotheses}.json"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", nargs="+", default=["aircraft", "adsb"], choices=sorted(CASES))
    parser.add_argument("--rates", nargs="+", type=float, default=list(RATES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--hypotheses", type=int, default=30)
    parser.add_argument("--most-tracks", type=int, default=1000, help="tracks of a setting that are scored")
    parser.add_argument("--work", type=Path, default=WORK)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--picture", type=Path, metavar="SIDE", help="draw a scene of this side file into images/height.png")
    parser.add_argument("--scene", type=int, default=0, help="which one (default %(default)s)")
    parser.add_argument("--quiet", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(main())
