"""What do the checks cost that look for what can hardly be meant?

The stage extract, from the opening of a log to its tables, with all checks and with every kind trusted, in turns in one
process, of which the least of each round counts: on a mixed log as a robot records it (see `mixed_logs`), on recorded ships,
and on a log of nothing but positions.

    python -m benchmarks.plausibility --publish docs
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import get_args

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks import publishing
from benchmarks.mixed_logs import START_NS, write_mixed_log
from benchmarks.publishing import Measurement
from pipeline.extract.config import ExtractConfig
from pipeline.extract.writing import write_tables
from pipeline.logs.reader import open_log
from pipeline.mapping.sources import SourceConfig
from pipeline.progress import Progress
from pipeline.suspicions import LogKind

SIZE_MB = 100.0
NUM_POSITIONS = 200_000
NUM_TARGETS = 20
NUM_ROUNDS = 5
SHIPS = Path(__file__).resolve().parents[2] / "shared" / "data" / "maritime" / "solent_ais_known.mcap"
EVERY_KIND: tuple[LogKind, ...] = get_args(LogKind)


def write_positions(path: Path, num_positions: int) -> None:
    """Targets that go straight ahead, each on a topic of its own and seen five times a second, to a metre."""
    store, rng = get_typestore(Stores.ROS2_HUMBLE), np.random.default_rng(0)
    name = "geometry_msgs/msg/PoseStamped"
    types = store.types
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="positions")
        schema = writer.register_schema(name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode())
        channels = [writer.register_channel(f"/contacts/v{number}", "cdr", schema) for number in range(NUM_TARGETS)]
        for number in range(num_positions):
            target, time_ns = number % NUM_TARGETS, START_NS + number * 10_000_000
            x, y = rng.normal((0.05 * number, 100.0 * target), 1.0)
            place = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x=x, y=y, z=0.0), turn)
            stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
            message = types[name](types["std_msgs/msg/Header"](stamp=stamp, frame_id="map"), place)
            logged_ns = time_ns + int(rng.integers(1, 50)) * 1_000_000
            writer.add_message(channels[target], logged_ns, bytes(store.serialize_cdr(message, name)), logged_ns, number)
        writer.finish()


def extracted_s(path: Path, config: ExtractConfig) -> float:
    """Processor time of the stage."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        summary = write_tables(open_log(path), Path(folder), config, Progress(quiet=True))
        spent_s = time.process_time() - begin
    if summary["suspicions"]:
        raise SystemExit(f"plausibility: {path.name} is sound, but: {summary['suspicions']}")
    return spent_s


def cost_row(log: str, path: Path, sources: tuple[SourceConfig, ...], repeats: int) -> publishing.Row:
    """The least of several runs with and without checks, and by how many per cent they differ in the rounds."""
    rounds = np.array([_round(path, sources, repeats) for _ in range(NUM_ROUNDS)])
    more = 100 * (rounds[:, 0] / rounds[:, 1] - 1)
    with_s, without_s = rounds.min(axis=0).tolist()
    return {
        "log": log, "size_mb": path.stat().st_size / 1e6, "with_s": with_s, "without_s": without_s,
        "more_percent": float(np.median(more)), "more_low": float(more.min()), "more_high": float(more.max()),
    }  # fmt: skip


def _round(path: Path, sources: tuple[SourceConfig, ...], repeats: int) -> tuple[float, float]:
    """The least times with and without checks, each first in half of the pairs."""
    configs = ExtractConfig(detections=sources), ExtractConfig(detections=sources, trusted=EVERY_KIND)
    times: tuple[list[float], list[float]] = [], []
    for number in range(repeats):
        for which in (0, 1) if number % 2 else (1, 0):
            times[which].append(extracted_s(path, configs[which]))
    return min(times[0]), min(times[1])


def section(measured: Measurement) -> str:
    """How much longer the stage takes."""
    heads = ["log", "MB", f"with all checks, % longer (median and range of {NUM_ROUNDS} rounds)"]
    lines = [
        [row["log"], f"{row['size_mb']:.1f}", f"{row['more_percent']:.1f} ({row['more_low']:.1f} to {row['more_high']:.1f})"]
        for row in measured.rows()
    ]
    return publishing.table(heads, lines)


def main() -> int:
    """Measure, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--size-mb", type=float, default=SIZE_MB, help="size of the mixed log")
    parser.add_argument("--num-positions", type=int, default=NUM_POSITIONS, help="in the log of nothing else")
    parser.add_argument("--repeats", type=int, default=6, help="runs of a round, of which the fastest counts")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        mixed, positions = Path(name) / "mixed.mcap", Path(name) / "positions.mcap"
        write_mixed_log(mixed, arguments.size_mb)
        write_positions(positions, arguments.num_positions)
        odometry = (SourceConfig("/odom", agent="robot"),)
        rows = [cost_row("mixed, detections from one of ten topics", mixed, odometry, arguments.repeats)]
        if SHIPS.is_file():
            rows.append(cost_row("recorded ships (protobuf)", SHIPS, (), 3 * arguments.repeats))
        rows.append(cost_row("nothing but positions", positions, (), arguments.repeats))
    facts = publishing.facts_of("plausibility") | {"num_positions": arguments.num_positions, "num_repeats": arguments.repeats}
    publishing.publish(Measurement("plausibility", facts, {"plausibility": rows}), section, arguments.publish)
    return 0


if __name__ == "__main__":
    sys.exit(main())
