"""What do workers, and windows drawn together, bring to a batch, and do results depend on them?

Simulated logs and five broken ones are run twice, by one worker and by several, into folders of their own, one run right after
the other. Then windows of one log are drawn by the shipped `prison` checkpoint alone and together.

    python benchmarks/batch.py --publish docs/benchmarks
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import torch

from cadence.constraints.obstacles import Obstacles
from pipeline.batch import RunConfig
from pipeline.checkpoints import checkpoint_hash, find_checkpoint
from pipeline.config import stage_config
from pipeline.manifest import hash_file, write_atomic
from pipeline.progress import Progress
from pipeline.provenance import versions
from pipeline.run import run
from pipeline.scene import load_scene, scene_context, scene_grid
from pipeline.simulate import SimulateConfig, simulate
from pipeline.tables import read_table
from pipeline.windows import build_windows, plan_grid

NUM_BROKEN = 5
SIZES = (1, 2, 4, 8, 16)
SIMULATE = ("simulate.patrol.duration_s=600", "simulate.patrol.detection_rate=0.3")
SETTINGS = (
    "infer.checkpoint=none", "infer.num_hypotheses=4", "infer.grid.history_steps=16", "infer.grid.horizon_steps=16",
    "infer.grid.stride_steps=32", "infer.guidance.mode=none",
)  # fmt: skip
_QUIET = Progress(quiet=True)


def write_logs(folder: Path, count: int) -> None:
    """`count` simulated logs, and broken ones between them."""
    simulate(folder, stage_config(SimulateConfig, "simulate", None, [*SIMULATE, f"simulate.num_episodes={count}"]), _QUIET)
    sound = sorted(folder.glob("*.mcap"))[0].read_bytes()
    for number in range(NUM_BROKEN):
        content = (b"", b"not an MCAP", sound[:50], bytes(5000), sound[:8] + bytes(3000))[number]
        (folder / f"patrol-0-{number * count // NUM_BROKEN:04d}-broken.mcap").write_bytes(content)


def batch_table(folder: Path, num_workers: int) -> list[str]:
    """A row for each number of workers; every other run must give the same hypotheses as the first."""
    config = stage_config(RunConfig, None, None, SETTINGS)
    lines, first_s, first = [], 0.0, dict[str, str]()
    run([str(next(folder.glob("logs/*.mcap")))], str(folder / "warm"), config, _QUIET, num_workers=1)  # imports once for all
    for workers in (1, num_workers):
        out, begin_s = folder / f"workers-{workers}", time.monotonic()
        outcomes = run([str(folder / "logs")], str(out), config, _QUIET, num_workers=workers)
        elapsed_s = time.monotonic() - begin_s
        found = {str(path.relative_to(out)): hash_file(path) for path in out.rglob("*.parquet")}
        first_s, first = first_s or elapsed_s, first or found
        failed = [outcome for outcome in outcomes if outcome.exit_code]
        if found != first or len(failed) != NUM_BROKEN or any("broken" not in outcome.message for outcome in failed):
            raise SystemExit(f"batch: {workers} workers gave other results, or other failures than those of broken logs")
        lines.append(f"| {workers} | {len(outcomes) - len(failed)} | {len(failed)} | {first_s / elapsed_s:.2f} | yes |")
    return lines


def window_table(detections_path: Path, num_hypotheses: int = 30) -> list[str]:
    """A row for each number of windows that are drawn together: processor time a window, and whether the bits are the same."""
    detections, _ = read_table(detections_path, "detections")
    model = load_scene(find_checkpoint("prison"))
    windows = build_windows(detections, plan_grid(detections, scene_grid(model.config, 1)), 0)
    context = scene_context(windows, int(detections["time_ns"][0].as_py()))
    count = min(max(SIZES), windows.batch.num_windows)

    def draw(part: torch.Tensor) -> torch.Tensor:
        return model.placed(context[part], Obstacles.none()).sample(windows.batch[part], num_hypotheses).position_m.nan_to_num()

    together = draw(torch.arange(count))
    lines, alone_s = [], 0.0
    for size in [size for size in SIZES if size <= count]:
        begin_s, difference_m = time.process_time(), 0.0
        for part in torch.arange(count).split(size):
            difference_m = max(difference_m, float((draw(part) - together[part]).abs().max()))
        elapsed_s = time.process_time() - begin_s
        alone_s = alone_s or elapsed_s
        lines.append(f"| {size} | {alone_s / elapsed_s:.2f} | {difference_m:.3f} |")
    return lines


def main() -> int:
    """Both tables, printed and published."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, help="folder for batch.md")
    parser.add_argument("--logs", type=int, default=100, help="simulated logs")
    parser.add_argument("--workers", type=int, default=max(2, len(os.sched_getaffinity(0))), help="of the second run")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_logs(folder / "logs", arguments.logs)
        batch = batch_table(folder, arguments.workers)
        detections = max((folder / "workers-1").glob("*/detections.parquet"), key=lambda path: (path.stat().st_size, path))
        windows = window_table(detections)
    text = HEAD.format(
        num_logs=arguments.logs, num_broken=NUM_BROKEN, cores=len(os.sched_getaffinity(0)), settings="`, `".join(SETTINGS),
        simulate="`, `".join(SIMULATE), batch="\n".join(batch), windows="\n".join(windows),
        checkpoint=f"prison, {checkpoint_hash(find_checkpoint('prison'))}",
        versions=", ".join(f"{name} {number}" for name, number in versions().items()),
    )  # fmt: skip
    sys.stdout.write(text)
    if arguments.publish is not None:
        write_atomic(arguments.publish / "batch.md", text)
    return 0


HEAD = """# What do workers, and windows drawn together, bring to a batch?

    python benchmarks/batch.py

{num_logs} simulated logs and {num_broken} broken ones among them, all stages; one thread a worker, {cores} logical cores.
Speed is a ratio of wall times, one run right after the other, after a run of one log that is not counted. All Parquet files of
the runs were compared byte by byte; every broken log failed with a line of its own, and nothing else did. Settings:
`{simulate}`, `{settings}`.

| workers | finished | failed | speed | same bytes |
|---|---|---|---|---|
{batch}

Windows of one log, 30 hypotheses each, drawn by the shipped checkpoint for the prison world, so many together; one thread,
ratios of processor times. Draws of a window differ by rounding alone where few windows are drawn together, because matrix
products of other sizes add up in another order. `cadence run` draws up to 32 windows of one log together, and never windows of
several logs: the gain would end where a log has a few windows of its own, and hypotheses would depend on which logs were given.

| windows together | speed | largest difference from all together, m |
|---|---|---|
{windows}

Checkpoint: {checkpoint}. Versions: {versions}.
"""


if __name__ == "__main__":
    sys.exit(main())
