"""How large are our files, how fast are they written, and how should chunks be packed?

Scenes of three agents with thirty hypotheses of sixty steps are drawn and encoded as `cadence export` does, written with every
packing, read back with the `mcap` library, and appended to a generated log of 300 MB. Every ratio is of two times taken in this
run, one after the other, each the best of a few.

    python benchmarks/log_writing.py --publish docs/benchmarks
"""

import argparse
import itertools
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap import records
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from pipeline.export.display import Style, draw, scene_entities
from pipeline.export.messages import encode_agents, encode_hypotheses
from pipeline.export.playback import Scene, build_scenes, plan_ticks
from pipeline.export.scene import Entity, encode_scene
from pipeline.export.stage import ExportConfig, num_vertices
from pipeline.files import write_atomic
from pipeline.logs.append import write_combined
from pipeline.logs.recorder import Packing
from pipeline.logs.writer import LogWriter, schema_bytes
from pipeline.progress import Progress
from pipeline.provenance import versions
from pipeline.results import AgentHypotheses, MissionHypotheses, WindowHypotheses
from pipeline.tables import Frame
from schemas import channels
from schemas.channels import Channel

Message = tuple[Channel, int, bytes]

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
SIZE_LIMIT_MB, ENCODING_FACTOR, REWRITE_FACTOR, COPY_FACTOR = 28.0, 40.0, 10.0, 3.0
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
    style = Style(AGENT_IDS, (0.0, 0.0), EXTENT_M, 0.0, NUM_HYPOTHESES, num_vertices(len(scenes), len(ticks), ExportConfig()))
    found: list[Message] = []
    waiting = iter(made.windows)
    window = next(waiting, None)
    for tick in ticks:
        while window is not None and window.origin_ns <= tick.time_ns:
            found.append((channels.HYPOTHESES, tick.time_ns, encode_hypotheses(window, FRAME, tick.time_ns)))
            window = next(waiting, None)
        found.append((channels.SCENE, tick.time_ns, encode_scene(tick.time_ns, FRAME.frame_id, entities(tick.scene, style))))
        found.append((channels.AGENTS, tick.time_ns, encode_agents(tick, tick.time_ns)))
    return found


def entities(scene: Scene | None, style: Style) -> list[Entity]:
    """What is to be seen of a scene at its origin."""
    return scene_entities(draw(scene, style), scene.origin_ns, (), style) if scene else []


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


def write_with_library(path: Path, messages: list[Message]) -> None:
    """The same messages, chunk size and checksums through the library's writer."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=Packing().chunk_bytes, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start("", "library")
        ids: dict[Channel, int] = {}
        for number, (channel, time_ns, data) in enumerate(messages):
            if channel not in ids:
                schema = writer.register_schema(channel.message, "protobuf", schema_bytes(channel.message))
                ids[channel] = writer.register_channel(channel.topic, "protobuf", schema)
            writer.add_message(ids[channel], time_ns, data, time_ns, number)
        writer.finish()


def packing_rows(folder: Path, fresh: list[Message], kept: list[Message]) -> list[str]:
    """One row a packing; times as multiples of those of the default."""
    taken = {packing: measure_packing(folder / "packed.mcap", fresh, kept, packing) for packing in (Packing(), *PACKINGS)}
    base = taken[Packing()]
    lines = []
    for packing in PACKINGS:
        fresh_bytes, kept_bytes, *times = taken[packing]
        sizes = [f"{size / 1e6 / hours(rows):.1f}" for size, rows in ((fresh_bytes, fresh), (kept_bytes, kept))]
        ratios = [f"{value / reference:.2f}" for value, reference in zip(times, base[2:], strict=True)]
        name = f"zstd {packing.level}" if packing.compression == "zstd" else packing.compression
        mark = " (default)" if packing == Packing() else ""
        lines.append(f"| {name} | {packing.chunk_bytes // 1024}{mark} | {' | '.join([*sizes, *ratios])} |")
    return lines


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


def writing_rows(folder: Path, kept: list[Message]) -> list[str]:
    """Our writer beside the library's."""
    small = [(channels.AGENTS, number * 10**6, bytes(120)) for number in range(100_000)]
    lines = []
    for name, messages in (("scenes", kept), ("100 000 messages of 120 bytes", small)):
        library = best_of(lambda messages=messages: write_with_library(folder / "library.mcap", messages))
        ours = best_of(lambda messages=messages: write(folder / "ours.mcap", messages, Packing()))
        lines.append(f"| {name} | {library / ours:.1f} |")
    return lines


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


def rewrite(source: Path, side: Path, target: Path) -> None:
    """What `mcap` offers for the same end: read every record of both files and write it again, by time."""
    with source.open("rb") as source_file, side.open("rb") as side_file, target.open("wb") as target_file:
        writer = Writer(target_file, compression=CompressionType.ZSTD)
        writer.start("", "library")
        added = rewritten(side_file, writer)
        waiting = next(added, None)
        for time_ns in rewritten(source_file, writer):
            while waiting is not None and waiting <= time_ns:
                waiting = next(added, None)
        for _ in added:
            pass
        writer.finish()


def rewritten(file: object, writer: Writer) -> Iterator[int]:
    """Copy record by record; the log time of each message before it is copied."""
    schemas, ids = {0: 0}, {}
    for record in StreamReader(file).records:
        match record:
            case records.Schema():
                if record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            case records.Channel():
                if record.id not in ids:
                    schema = schemas[record.schema_id]
                    ids[record.id] = writer.register_channel(record.topic, record.message_encoding, schema, record.metadata)
            case records.Message():
                yield record.log_time
                writer.add_message(ids[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence)
            case records.Attachment():
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            case records.Metadata():
                writer.add_metadata(record.name, record.metadata)


def combining_rows(folder: Path, kept: list[Message]) -> tuple[list[str], bool]:
    """A combined file beside a re-write and beside a copy; whether the claims hold."""
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
    ratios = walls[2] / walls[1], processes[2] / processes[1], walls[1] / walls[0]
    line = f"| {source.stat().st_size / 1e6:.0f} | {ratios[0]:.1f} | {ratios[1]:.1f} | {ratios[2]:.2f} |"
    return [line], ratios[0] >= REWRITE_FACTOR and ratios[2] <= COPY_FACTOR


def fresh_copy(source: Path, side: Path, target: Path) -> None:
    """A plain copy; the side file is left out."""
    shutil.copyfile(source, target)


def combine(source: Path, side: Path, target: Path) -> None:
    """As export does with `export.combined`."""
    write_combined(source, side, target, Packing(), QUIET)


def encoding_rows(num_scenes: int = 20) -> tuple[list[str], bool]:
    """The numpy encoder beside the published classes filled point by point."""
    scenes = build_scenes(mission(num_scenes, 1))
    lines, holds = [], True
    for vertices in (15, 32, 60):
        style = Style(AGENT_IDS, (0.0, 0.0), EXTENT_M, 0.0, NUM_HYPOTHESES, vertices)
        drawn = [(scene.origin_ns, entities(scene, style)) for scene in scenes]
        ours = best_of(lambda drawn=drawn: [encode_scene(time_ns, "map", found) for time_ns, found in drawn])
        slow = best_of(lambda drawn=drawn: [encode_point_by_point(time_ns, found) for time_ns, found in drawn], 1)
        same = all(SceneUpdate.FromString(encode_scene(t, "map", e)) == point_by_point(t, e) for t, e in drawn[:3])
        lines.append(f"| {vertices} | {slow / ours:.0f} | {'yes' if same else 'no'} |")
        holds = holds and same and (vertices < NUM_STEPS or slow >= ENCODING_FACTOR * ours)
    return lines, holds


def encode_point_by_point(time_ns: int, found: list[Entity]) -> bytes:
    """As one would write it by the book."""
    data: bytes = point_by_point(time_ns, found).SerializeToString()
    return data


def point_by_point(time_ns: int, found: list[Entity], frame_id: str = "map") -> SceneUpdate:
    """The message of `encode_scene`, built with the published classes."""
    update = SceneUpdate()
    update.deletions.add(type=SceneEntityDeletion.ALL).timestamp.FromNanoseconds(time_ns)
    for entity in found:
        out = update.entities.add(frame_id=frame_id, id=entity.id)
        out.timestamp.FromNanoseconds(time_ns)
        for spheres in entity.spheres:
            for center in spheres.center_m:
                sphere = out.spheres.add()
                sphere.pose.position.x, sphere.pose.position.y, sphere.pose.position.z = center
                sphere.pose.orientation.w = 1.0
                sphere.size.x = sphere.size.y = sphere.size.z = spheres.diameter_m
                sphere.color.r, sphere.color.g, sphere.color.b, sphere.color.a = spheres.color
        for lines in entity.lines:
            for points, color in zip(lines.point_m, lines.color, strict=True):
                line = out.lines.add(type=int(lines.type), thickness=lines.thickness_px, scale_invariant=True)
                line.pose.orientation.w = 1.0
                for x, y, z in points:
                    line.points.add(x=x, y=y, z=z)
                line.color.r, line.color.g, line.color.b, line.color.a = color
        for label in entity.labels:
            text = out.texts.add(billboard=True, font_size=14.0, scale_invariant=True, text=label.text)
            text.pose.position.x, text.pose.position.y, text.pose.position.z = label.position_m
            text.pose.orientation.w = 1.0
            text.color.r, text.color.g, text.color.b, text.color.a = label.color
    return update


def scene_size_mb(folder: Path, fresh: list[Message]) -> float:
    """Megabytes an hour of a file that holds the scenes alone, with a new window in every one."""
    scenes = [message for message in fresh if message[0] == channels.SCENE]
    write(folder / "scenes.mcap", scenes, Packing())
    return (folder / "scenes.mcap").stat().st_size / 1e6 / hours(scenes)


def main() -> int:
    """The tables, printed and published; 1 where a claim does not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, help="folder for log_writing.md")
    arguments = parser.parse_args()
    fresh, kept = side_messages(240, 1, 240), side_messages(20, 20, 400)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        size_mb = scene_size_mb(folder, fresh)
        packing, writing = packing_rows(folder, fresh, kept), writing_rows(folder, kept)
        combining, combines = combining_rows(folder, kept)
    encoding, encodes = encoding_rows()
    made_with = ", ".join(f"{name} {number}" for name, number in versions().items())
    text = PAGE.format(
        versions=made_with, size_mb=size_mb, size_limit_mb=SIZE_LIMIT_MB, packing="\n".join(packing),
        writing="\n".join(writing), combining="\n".join(combining), encoding="\n".join(encoding),
        encoding_factor=ENCODING_FACTOR, rewrite_factor=REWRITE_FACTOR, copy_factor=COPY_FACTOR,
    )  # fmt: skip
    sys.stdout.write(text)
    if arguments.publish is not None:
        write_atomic(arguments.publish / "log_writing.md", text)
    return 0 if combines and encodes and size_mb <= SIZE_LIMIT_MB else 1


PAGE = """# Writing logs

    python benchmarks/log_writing.py

Three agents, thirty hypotheses of sixty steps each, a scene a second, drawn and encoded as `cadence export` does with its
defaults. One thread, CPU, no GPU. Ratios are of the process's own time unless "wall" is said; all were
taken in one run. MB are 10^6 bytes. Versions: {versions}.

## Scenes

Scenes alone, where *every* scene shows new hypotheses (a window a second, nothing in common with the one before):
**{size_mb:.1f} MB an hour** (claim: at most {size_limit_mb:g}). Hypotheses that stay for some seconds cost less, see below.

The encoder beside the published protobuf classes filled point by point (claim: at least {encoding_factor:g} times faster for
all sixty points; every message compared is the same):

| points a hypothesis | times faster | same message |
|---|---|---|
{encoding}

With few points, what is left is the work a line group, not a point.

## Chunks

*New*: a window a second, 15 points a hypothesis (the default where windows are that short). *Kept*: a window every twenty
seconds, 32 points. Both files hold the scenes, the hypotheses without loss, and the numbers for plots; in the first most bytes
are those hypotheses, float32 that no compressor can shorten. Times are multiples of those of the default packing, for the
second file: to write it, to read the plot's topic alone, and to find the last scene before a moment, both with the reader of
`mcap`.

| compression | chunk, KiB | new, MB an hour | kept, MB an hour | write | read one topic | seek |
|---|---|---|---|---|---|---|
{packing}

zstd at its first level is the default: on doubles that were rounded, higher levels cost time and win next to nothing, and lz4,
with its short memory, does not see that a scene resembles the one before. Chunks of 2 MiB: a chunk has to hold many scenes for
that resemblance to count, and those of large missions take 200 kB each; beyond, files shrink by a few per cent, while the time
of a seek grows with the chunk, because viewers unpack a whole one to find one message.

## Our writer and the library's

The same messages, checksums and chunk size, zstd at the library's only level, through `mcap.writer.Writer`:

| messages | times faster |
|---|---|
{writing}

## Combined files

`export.combined` copies a log byte for byte up to the end of its data and appends our chunks and a common index. Beside it,
reading and writing all records again with `mcap` (claim: at least {rewrite_factor:g} times slower), and a plain copy of the log
with `shutil.copyfile` (claim: at most {copy_factor:g} times faster). The log has ten topics, attachments and metadata; our part
is the second file of above.

| log, MB | re-write / combined, wall | re-write / combined | combined / copy, wall |
|---|---|---|---|
{combining}

The stage as a whole also hashes the log, to see that it is the one that was ingested, and the files that it has written.
"""


if __name__ == "__main__":
    sys.exit(main())
