"""How large are our files, how fast are they written, and how should chunks be packed?

Scenes of three agents with thirty hypotheses of sixty steps are drawn and encoded as `cadence export` does, written with every
packing, read back with the `mcap` library, and appended to a generated log of 300 MB. Every ratio is of two times taken in this
run, one after the other, each the best of a few.

    python -m benchmarks.log_writing --publish docs
"""

import argparse
import itertools
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from benchmarks import publishing
from benchmarks.log_writing_usual import Message, encode_point_by_point, point_by_point, rewrite, write_with_library
from benchmarks.publishing import Measurement
from pipeline.export.config import ExportConfig
from pipeline.export.display import Style, hypothesis_entities, present_entities
from pipeline.export.messages import encode_agents, encode_hypotheses
from pipeline.export.mission import num_vertices
from pipeline.export.playback import Scene, build_scenes, plan_ticks, shows_new_scene
from pipeline.export.scene import Entity, encode_scene
from pipeline.export.sizes import mark_sizes_m
from pipeline.logs.append import write_combined
from pipeline.logs.recorder import Packing
from pipeline.logs.writer import LogWriter
from pipeline.progress import Progress
from pipeline.results import AgentHypotheses, MissionHypotheses, WindowHypotheses
from pipeline.tables import Frame
from schemas import channels

SECOND_NS = 10**9
FRAME = Frame("map")
EXTENT_M = 1000.0
AGENT_IDS = ("T0", "T1", "T2")
NUM_HYPOTHESES, NUM_STEPS, ORIGIN_INDEX = 30, 60, 30
PACKINGS = [
    Packing(compression, chunk_kb * 1024, level)
    for compression, level in (("none", 0), ("lz4", 0), ("zstd", 1), ("zstd", 3), ("zstd", 6))
    for chunk_kb in (256, 1024, 2048, 4096, 8192)
]
SIZE_LIMIT_MB, ENCODING_FACTOR, REWRITE_FACTOR, COPY_FACTOR = 28.0, 8.0, 10.0, 3.0
SHOWN = (("none", 1024), ("lz4", 2048), ("zstd 1", 256), ("zstd 1", 8192), ("zstd 6", 2048))
"""Packings of the page, beside the default."""
QUIET = Progress(quiet=True)


def tracks(rng: np.random.Generator) -> np.ndarray:
    """Tracks [K, T, 2] through one place at the origin, three metres a second, that turn as an Ornstein-Uhlenbeck process."""
    drift = rng.normal(0, 3.0, 2)
    velocity = np.empty((NUM_HYPOTHESES, NUM_STEPS, 2))
    velocity[:, 0] = drift + rng.normal(0, 0.3, (NUM_HYPOTHESES, 2))
    for step in range(1, NUM_STEPS):
        velocity[:, step] = 0.98 * velocity[:, step - 1] + 0.02 * drift + rng.normal(0, 0.25, (NUM_HYPOTHESES, 2))
    position = np.cumsum(velocity, axis=1)
    position -= position[:, ORIGIN_INDEX : ORIGIN_INDEX + 1]
    return (position + rng.normal(0, 5.0, (NUM_HYPOTHESES, 1, 2))).astype(np.float32)


def mission(num_windows: int, stride_s: int) -> MissionHypotheses:
    """A mission whose windows have nothing in common, one every `stride_s`."""
    rng = np.random.default_rng(1)
    windows = []
    for number in range(num_windows):
        agents = tuple(
            AgentHypotheses(name, "ok", None, 5, 3.0, 10.0, tuple(rng.uniform(-400.0, 400.0, 2).tolist()), tracks(rng))
            for name in AGENT_IDS
        )
        weight = rng.dirichlet(np.full(NUM_HYPOTHESES, 3.0)).astype(np.float32)
        index, origin_ns = np.arange(NUM_HYPOTHESES, dtype=np.int32), number * stride_s * SECOND_NS
        windows.append(WindowHypotheses("bench", number, origin_ns, SECOND_NS, ORIGIN_INDEX, NUM_STEPS, index, weight, agents))
    return MissionHypotheses(FRAME, AGENT_IDS, tuple(windows))


def side_messages(num_windows: int, stride_s: int, duration_s: int) -> list[Message]:
    """Everything that is written for such a mission at a scene a second, but for detections and the heat map."""
    made = mission(num_windows, stride_s)
    scenes = build_scenes(made)
    ticks = plan_ticks(scenes, SECOND_NS, (duration_s - 1) * SECOND_NS)
    style = style_of(scenes, num_vertices(scenes, ExportConfig()))
    found: list[Message] = []
    waiting = iter(made.windows)
    window = next(waiting, None)
    for index, tick in enumerate(ticks):
        while window is not None and window.origin_ns <= tick.time_ns:
            found.append((channels.HYPOTHESES, tick.time_ns, encode_hypotheses(window, FRAME, tick.time_ns)))
            window = next(waiting, None)
        if shows_new_scene(ticks, index):
            lines = encode_scene(tick.time_ns, FRAME.frame_id, entities(tick.scene, style))
            found.append((channels.SCENE, tick.time_ns, lines))
        moving = present_entities(tick.scene, tick.time_ns, (), style) if tick.scene else ()
        found.append((channels.PRESENT, tick.time_ns, encode_scene(tick.time_ns, FRAME.frame_id, moving)))
        found.append((channels.AGENTS, tick.time_ns, encode_agents(tick, tick.time_ns)))
    return found


def style_of(scenes: list[Scene], max_vertices: int) -> Style:
    """How such a mission is drawn."""
    return Style(AGENT_IDS, (0.0, 0.0), EXTENT_M, 0.0, NUM_HYPOTHESES, max_vertices, mark_sizes_m(scenes, {}, EXTENT_M))


def entities(scene: Scene | None, style: Style) -> list[Entity]:
    """The lines of a scene."""
    return hypothesis_entities(scene, (), style) if scene else []


def best_of(function: Callable[[], object], repeats: int = 3, clock: Callable[[], float] = time.process_time) -> float:
    """The shortest time, in seconds of this process: what else the machine does shall not count."""
    found = []
    for _ in range(repeats):
        begin = clock()
        function()
        found.append(clock() - begin)
    return min(found)


def write(path: Path, messages: list[Message], packing: Packing) -> None:
    """As export writes."""
    with LogWriter(path, packing) as writer:
        for message in messages:
            writer.write(*message)


def packing_rows(folder: Path, fresh: list[Message], kept: list[Message]) -> list[publishing.Row]:
    """One row a packing; times as multiples of those of the default."""
    taken = {packing: measure_packing(folder / "packed.mcap", fresh, kept, packing) for packing in (Packing(), *PACKINGS)}
    base = taken[Packing()]
    rows = []
    for packing in PACKINGS:
        fresh_bytes, kept_bytes, *times = taken[packing]
        ratios = [value / reference for value, reference in zip(times, base[2:], strict=True)]
        rows.append({
            "compression": f"zstd {packing.level}" if packing.compression == "zstd" else packing.compression,
            "chunk_kib": packing.chunk_bytes // 1024, "is_default": "yes" if packing == Packing() else "no",
            "new_mb_an_hour": fresh_bytes / 1e6 / hours(fresh), "kept_mb_an_hour": kept_bytes / 1e6 / hours(kept),
            **dict(zip(("write_ratio", "read_topic_ratio", "seek_ratio"), ratios, strict=True)),
        })  # fmt: skip
    return rows


def measure_packing(path: Path, fresh: list[Message], kept: list[Message], packing: Packing) -> list[float]:
    """Sizes of both files, and seconds to write the second one, to read its smallest topic, and to go to a moment."""
    write(path, fresh, packing)
    sizes = [float(path.stat().st_size)]
    writing = best_of(lambda: write(path, kept, packing), 2)
    sizes.append(float(path.stat().st_size))
    with path.open("rb") as file:
        reader = make_reader(file)
        filtered = best_of(lambda: list(reader.iter_messages(topics=[channels.AGENTS.topic])), 2)
        moments = np.random.default_rng(0).uniform(0.0, kept[-1][1], 20).astype(np.int64).tolist()
        seeking = best_of(lambda: [scene_at(reader, moment) for moment in moments], 2)
    return [*sizes, writing, filtered, seeking]


def scene_at(reader: object, time_ns: int) -> object:
    """What a viewer shows after a seek: the last scene before a moment."""
    return next(iter(reader.iter_messages(topics=[channels.SCENE.topic], ending_at=time_ns, reverse=True)))


def hours(messages: list[Message]) -> float:
    """How long a mission lasts."""
    return (messages[-1][1] / SECOND_NS + 1.0) / 3600.0


def writing_rows(folder: Path, kept: list[Message]) -> list[publishing.Row]:
    """Our writer beside the library's."""
    small = [(channels.AGENTS, number * 10**6, bytes(120)) for number in range(100_000)]
    rows = []
    for name, messages in (("scenes", kept), ("100 000 messages of 120 bytes", small)):
        library = best_of(lambda messages=messages: write_with_library(folder / "library.mcap", messages))
        ours = best_of(lambda messages=messages: write(folder / "ours.mcap", messages, Packing()))
        rows.append({"messages": name, "times_faster": library / ours})
    return rows


def generate_source(path: Path, num_bytes: int = 300_000_000) -> None:
    """A mixed log: ten topics, attachments and metadata among the chunks; half of each message is noise."""
    rng = np.random.default_rng(2)
    noise = rng.bytes(2**22)
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2", "generated")
        schema = writer.register_schema("std_msgs/msg/UInt8MultiArray", "ros2msg", b"uint8[] data")
        ids = [writer.register_channel(f"/sensor/{number}", "cdr", schema) for number in range(10)]
        for number in itertools.count():
            if number % 20_000 == 0:
                writer.add_attachment(number, number, f"map {number}", "application/octet-stream", noise[: 2**21])
                writer.add_metadata(f"state {number}", {"battery": str(number)})
                if file.tell() >= num_bytes:
                    break
            begin, length = int(rng.integers(2**22 - 4096)), 200 + 300 * (number % 10)
            writer.add_message(
                ids[number % 10], number * 10**6, bytes(length) + noise[begin : begin + length], number * 10**6, number
            )
        writer.finish()


def combining_row(folder: Path, kept: list[Message]) -> publishing.Row:
    """A combined file beside a re-write and beside a copy."""
    source, side, target = folder / "source.mcap", folder / "side.mcap", folder / "target.mcap"
    write(side, kept, Packing())
    generate_source(source)
    walls, processes = [float("inf")] * 3, [float("inf")] * 3
    for turn in range(8):  # in turn, because the disk's cache is not equally busy at all times
        for number, function in enumerate((fresh_copy, combine, rewrite)):
            if number < 2 or turn < 1:
                target.unlink(missing_ok=True)
                wall, process = time.perf_counter(), time.process_time()
                function(source, side, target)
                walls[number] = min(walls[number], time.perf_counter() - wall)
                processes[number] = min(processes[number], time.process_time() - process)
    return {
        "log_mb": source.stat().st_size / 1e6, "rewrite_over_combined_wall": walls[2] / walls[1],
        "rewrite_over_combined": processes[2] / processes[1], "combined_over_copy_wall": walls[1] / walls[0],
    }  # fmt: skip


def fresh_copy(source: Path, side: Path, target: Path) -> None:
    """A plain copy; the side file is left out."""
    shutil.copyfile(source, target)


def combine(source: Path, side: Path, target: Path) -> None:
    """As export does with `export.combined`."""
    write_combined(source, side, target, Packing(), QUIET)


def encoding_rows(num_scenes: int = 20) -> list[publishing.Row]:
    """The numpy encoder beside the published classes filled point by point."""
    scenes = build_scenes(mission(num_scenes, 1))
    rows = []
    for vertices in (6, 48):
        drawn = [(scene.origin_ns, entities(scene, style_of(scenes, vertices))) for scene in scenes]
        points = [len(point_m) for _, found in drawn for entity in found for lines in entity.lines for point_m in lines.point_m]
        ours = best_of(lambda drawn=drawn: [encode_scene(time_ns, "map", found) for time_ns, found in drawn])
        slow = best_of(lambda drawn=drawn: [encode_point_by_point(time_ns, found) for time_ns, found in drawn], 1)
        same = all(SceneUpdate.FromString(encode_scene(t, "map", e)) == point_by_point(t, e) for t, e in drawn[:3])
        rows.append({"num_points": sum(points) / len(points), "times_faster": slow / ours, "is_same": "yes" if same else "no"})
    return rows


def scene_size_mb(folder: Path, fresh: list[Message]) -> float:
    """Megabytes an hour of a file that holds the scenes alone, with a new window in every one."""
    scenes = [message for message in fresh if message[0] == channels.SCENE]
    write(folder / "scenes.mcap", scenes, Packing())
    return (folder / "scenes.mcap").stat().st_size / 1e6 / hours(scenes)


def main() -> int:
    """Measured, printed and published; 1 where a claim does not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    arguments = parser.parse_args()
    fresh, kept = side_messages(240, 1, 240), side_messages(20, 20, 400)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        size_mb = scene_size_mb(folder, fresh)
        tables = {
            "log_writing_scenes": [{"scene_mb_an_hour": size_mb, "aim_mb_an_hour": SIZE_LIMIT_MB}],
            "log_writing_encoding": encoding_rows(), "log_writing_packing": packing_rows(folder, fresh, kept),
            "log_writing_library": writing_rows(folder, kept), "log_writing_combined": [combining_row(folder, kept)],
        }  # fmt: skip
    measured = Measurement("log_writing", publishing.facts_of("log_writing"), tables)
    publishing.publish(measured, section, arguments.publish)
    return 0 if holds(measured) else 1


def holds(measured: Measurement) -> bool:
    """Whether sizes and speeds are as claimed."""
    (scenes,), (combined,) = measured.rows("scenes"), measured.rows("combined")
    encoding = measured.rows("encoding")
    return (
        scenes["scene_mb_an_hour"] <= SIZE_LIMIT_MB
        and all(row["is_same"] == "yes" for row in encoding)
        and encoding[-1]["times_faster"] >= ENCODING_FACTOR
        and combined["rewrite_over_combined_wall"] >= REWRITE_FACTOR
        and combined["combined_over_copy_wall"] <= COPY_FACTOR
    )


def section(measured: Measurement) -> str:
    """Sizes by packing, and our writers beside the usual ways."""
    heads = ["packing", "MB an hour", "write", "read one topic", "seek"]
    lines = [
        [f"{row['compression']}, chunks of {row['chunk_kib']} KiB", f"{row['kept_mb_an_hour']:.1f}"]
        + [f"{row[name]:.1f}" for name in ("write_ratio", "read_topic_ratio", "seek_ratio")]
        for row in measured.rows("packing")
        if row["is_default"] == "yes" or (row["compression"], row["chunk_kib"]) in SHOWN
    ]
    (scenes,), (combined,) = measured.rows("scenes"), measured.rows("combined")
    encoding = ", ".join(f"{row['times_faster']:.0f} ({row['num_points']:.0f})" for row in measured.rows("encoding"))
    library = ", ".join(f"{row['times_faster']:.1f} ({row['messages']})" for row in measured.rows("library"))
    return "\n".join([
        publishing.table(heads, lines), "",
        f"* Scenes in which every one shows new hypotheses take {scenes['scene_mb_an_hour']:.1f} MB an hour.",
        f"* They are encoded so many times as fast as with the published protobuf classes (points a line): {encoding}.",
        f"* Our writer is so many times as fast as the library's: {library}.",
        f"* A combined file of a log of {combined['log_mb']:.0f} MB is written "
        f"{combined['rewrite_over_combined_wall']:.0f} times as fast as by copying messages, and takes "
        f"{combined['combined_over_copy_wall']:.1f} times as long as a plain copy.",
    ])  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
