"""How fast are logs read, beside the readers of `mcap` and `mcap-ros2-support`, and in how much memory?

A mixed log of ten topics is written into a temporary folder (see `mixed_logs`), then both sides read it in turns, in one
process. Peak memory is that of a process of its own for every size, as the operating system counts it.

    python -m benchmarks.log_reading --publish docs
"""

import argparse
import hashlib
import os
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import publishing
from benchmarks.publishing import Measurement

SIZE_MB = 300.0
OTHER_FORMS_MB = 40.0
MEMORY_SIZES_MB = (50.0, 200.0, 800.0, 2000.0)
TOPIC = "/odom"
FIELDS = (
    "header.stamp.sec", "header.stamp.nanosec", "header.frame_id", "pose.pose.position.x", "pose.pose.position.y",
    "pose.pose.position.z", "pose.covariance",
)  # fmt: skip
_UNIT = 1024 if sys.platform.startswith("linux") else 1
_IMPORT = "import sys; from pipeline.logs.reader import open_log"
_READ = _IMPORT + "; log = open_log(sys.argv[1]); n = sum(1 for _ in log.messages()); sys.exit(n != log.health.num_messages)"
_OPEN = _IMPORT + "; sys.exit(open_log(sys.argv[1]).health.is_complete)"


@dataclass(frozen=True)
class Cost:
    """The least of several runs: wall time, and time on all processors."""

    wall_s: float
    cpu_s: float


def peak_of(command: str, path: Path | str) -> tuple[int, float, float]:
    """Exit code, peak of the resident memory in bytes and CPU seconds of a child process. This process must stay small."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen([sys.executable, "-c", command, str(path)], env=environment) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        return child.returncode, usage.ru_maxrss * _UNIT, usage.ru_utime + usage.ru_stime


def row_of(log: str, what: str, theirs: Cost, ours: Cost) -> publishing.Row:
    """What both sides did, and what it cost each."""
    return {
        "log": log, "what": what, "theirs_s": theirs.wall_s, "ours_s": ours.wall_s, "ratio": theirs.wall_s / ours.wall_s,
        "theirs_cpu_s": theirs.cpu_s, "ours_cpu_s": ours.cpu_s, "cpu_ratio": theirs.cpu_s / ours.cpu_s,
    }  # fmt: skip


def memory_rows(folder: Path, sizes_mb: Iterable[float]) -> list[publishing.Row]:
    """Peak memory over the size of the log: checked, then read as a whole."""
    rows = [{"log": "none: only imports", "size_mb": None, "peak_mb": peak_of(_IMPORT, "")[1] / 1e6}]
    for size_mb in sizes_mb:
        path = folder / "large.mcap"
        command = "import sys; from pathlib import Path; from benchmarks.mixed_logs import write_mixed_log"
        # In a process of its own: a child starts with its parent's peak.
        code = peak_of(f"{command}; write_mixed_log(Path(sys.argv[1]), {size_mb}, distinct_s=20)", path)[0]
        code, peak, _ = peak_of(_READ, path) if code == 0 else (code, 0, 0.0)
        if code:
            raise SystemExit(f"log_reading: a log of {size_mb} MB ended with exit code {code}")
        rows.append({"log": "mixed log", "size_mb": path.stat().st_size / 1e6, "peak_mb": peak / 1e6})
        path.unlink()
    return rows


def bomb_rows(folder: Path) -> list[publishing.Row]:
    """Seconds and peak memory of opening two small files that want to fill the memory or to keep the processor busy."""
    import zstandard

    zeros = bytes(2**28)
    packed = zstandard.compress(zeros)
    head = struct.pack("<QQQII", 1, 2, len(zeros), zlib.crc32(zeros), 4) + b"zstd" + struct.pack("<Q", len(packed))
    start = b"\x89MCAP0\r\n" + struct.pack("<BQII", 1, 8, 0, 0)
    bombs = {
        "a message of 2 GiB, as it says": start + struct.pack("<BQ", 5, 2**31) + bytes(65_000),
        "a chunk of 256 MiB of zeros": start + struct.pack("<BQ", 6, len(head) + len(packed)) + head + packed,
    }
    rows = []
    for name, data in bombs.items():
        path = folder / "bomb.mcap"
        path.write_bytes(data)
        code, peak, seconds = peak_of(_OPEN, path)
        verdict = "named as damaged" if code == 0 else "NOT NOTICED"
        sizes = {"size_kb": len(data) / 1e3, "outcome": verdict, "cpu_s": seconds, "peak_mb": peak / 1e6}
        rows.append({"file": name, **sizes})
    return rows


def theirs(path: Path) -> dict[str, Callable[[], int]]:
    """What `mcap` and `mcap-ros2-support` are asked to do; each returns the number of messages."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    def read(topics: list[str] | None = None) -> int:
        with path.open("rb") as file:
            return sum(1 for _ in make_reader(file).iter_messages(topics))

    def decode() -> int:
        with path.open("rb") as file:
            return sum(1 for _ in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages([TOPIC]))

    return {"all": read, "topic": lambda: read([TOPIC]), "decoded": decode}


def ours(path: Path) -> dict[str, tuple[str, Callable[[], int]]]:
    """What we are asked to do, and to which of `theirs` it is compared."""
    from pipeline.extract.channel_reader import ChannelReader
    from pipeline.extract.reading import read_positions
    from pipeline.logs.cdr_fields import CdrFields
    from pipeline.logs.decode import decoder_for
    from pipeline.logs.reader import MissionLog, open_log, reopen
    from pipeline.mapping.sources import SourceConfig
    from pipeline.progress import Progress

    checked = open_log(path)
    channel = next(channel for channel in checked.channels if channel.topic == TOPIC)

    def known() -> MissionLog:
        return reopen([path], checked.health)

    def decode() -> int:
        decoder = decoder_for(channel)
        return sum(1 for message in known().messages([TOPIC]) if decoder(message.data) is not None)

    def fields() -> int:
        reader = CdrFields(channel, FIELDS)
        return sum(int(reader.columns(batch)[0].sum()) for batch in known().batches([TOPIC]))

    def extracted() -> int:
        reader = ChannelReader(channel, SourceConfig(TOPIC), "detections", True, {})
        read_positions(known(), [reader], Progress(quiet=True))
        return len(reader.finish())

    return {
        "all messages": ("all", lambda: sum(1 for _ in known().messages())),
        "all messages, in columns": ("all", lambda: sum(map(len, known().batches()))),
        "all messages, and the whole log checked before": ("all", lambda: sum(1 for _ in open_log(path).messages())),
        "one topic": ("topic", lambda: sum(1 for _ in known().messages([TOPIC]))),
        "one topic, in columns": ("topic", lambda: sum(map(len, known().batches([TOPIC])))),
        "one topic, every message decoded": ("decoded", decode),
        "one topic, decoded to columns: stamp, frame, position, covariance": ("decoded", fields),
        "one topic, as extract reads it: rows of positions": ("decoded", extracted),
    }


def compare(path: Path, repeats: int) -> list[publishing.Row]:
    """All rows of the table of times; both sides in turns."""
    _check_equal(path)
    their_work, our_work = theirs(path), ours(path)
    costs: dict[str, list[Cost]] = {}
    for _ in range(repeats):
        for name, work in [*their_work.items(), *((name, work) for name, (_, work) in our_work.items())]:
            costs.setdefault(name, []).append(_measure(work))
    return [row_of("with index", name, _least(costs[other]), _least(costs[name])) for name, (other, _) in our_work.items()]


def share_rows(path: Path, repeats: int, theirs_cpu_s: float) -> list[publishing.Row]:
    """What the steps of reading all messages cost, each with all that come before it."""
    from zstandard import ZstdDecompressor

    from pipeline.logs.indexed import plan_by_index
    from pipeline.logs.records import PackedChunk, parse_chunk, unpack_chunk
    from pipeline.logs.timeline import read_span

    plan = plan_by_index(path)
    if plan is None:
        raise SystemExit("log_reading: the log cannot be planned by its index")

    def packed() -> Iterator[PackedChunk]:
        with path.open("rb") as file:
            for block in plan.blocks:
                yield parse_chunk(read_span(file, block.offset, block.length))

    def unpack(chunk: PackedChunk) -> bytes:
        return ZstdDecompressor().decompress(chunk.data, max_output_size=chunk.uncompressed_size)

    work = ours(path)
    steps: dict[str, Callable[[], int]] = {
        "bytes from the file": lambda: sum(len(chunk.data) for chunk in packed()),
        "chunks unpacked": lambda: sum(len(unpack(chunk)) for chunk in packed()),
        "their checksums compared": lambda: sum(len(unpack_chunk(chunk)) for chunk in packed()),
        "the index, and the places of messages: columns": work["all messages, in columns"][1],
        "an object with its own bytes for each message": work["all messages"][1],
    }
    costs = [{name: _measure(step) for name, step in steps.items()} for _ in range(repeats)]
    rows, before, spent = [], 0.0, {name: _least([cost[name] for cost in costs]).cpu_s for name in steps}
    for name, cpu_s in spent.items():
        share = 100 * (cpu_s - before) / max(spent.values())
        rows.append({"step": name, "cpu_s": cpu_s, "share_percent": share, "ratio_at_most": theirs_cpu_s / cpu_s})
        before = cpu_s
    return rows


def other_forms(folder: Path, repeats: int) -> list[publishing.Row]:
    """Logs in which every record has to be walked: without an index of chunks, and without chunks."""
    from mcap.reader import make_reader
    from mcap.writer import IndexType, Writer

    from benchmarks.mixed_logs import write_mixed_log
    from pipeline.logs.reader import open_log

    source, rows = folder / "source.mcap", []
    write_mixed_log(source, OTHER_FORMS_MB)
    forms: dict[str, dict[str, Any]] = {
        "chunks without index": {"index_types": IndexType.NONE}, "no chunks": {"use_chunking": False},
    }  # fmt: skip
    for form, options in forms.items():
        path, ids = folder / "form.mcap", {}
        with source.open("rb") as file, path.open("wb") as copy:
            writer = Writer(copy, chunk_size=2**20, **options)
            writer.start()
            for schema, channel, message in make_reader(file).iter_messages():
                if channel.id not in ids and schema is not None:
                    number = writer.register_schema(schema.name, schema.encoding, schema.data)
                    ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
                times = message.log_time, message.data, message.publish_time
                writer.add_message(ids[message.channel_id], *times, message.sequence)
            writer.finish()
        _check_equal(path)
        log = open_log(path)
        works: dict[str, Callable[[], int]] = {
            "opened, which checks it, and read": lambda path=path: sum(1 for _ in open_log(path).messages()),
            "read, once opened": lambda log=log: sum(1 for _ in log.messages()),
        }
        others, costs = [], {name: [] for name in works}
        for _ in range(2 * repeats):
            others.append(_measure(theirs(path)["all"]))
            for name, work in works.items():
                costs[name].append(_measure(work))
        rows += [row_of(form, name, _least(others), _least(costs[name])) for name in works]
    return rows


def _check_equal(path: Path) -> None:
    """Both readers give the same messages in the same order."""
    from mcap.reader import make_reader

    from pipeline.logs.reader import open_log

    digests = [hashlib.sha256(), hashlib.sha256()]
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            head = (channel.topic, message.log_time, message.publish_time, message.sequence)
            digests[0].update(repr(head).encode() + message.data)
    for raw in open_log(path).messages():
        head = (raw.channel.topic, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
        digests[1].update(repr(head).encode() + raw.data)
    if digests[0].digest() != digests[1].digest():
        raise SystemExit("log_reading: the readers do not give the same messages")


def _least(costs: list[Cost]) -> Cost:
    return Cost(min(cost.wall_s for cost in costs), min(cost.cpu_s for cost in costs))


def _measure(work: Callable[[], int]) -> Cost:
    wall, cpu = time.perf_counter(), time.process_time()
    if work() == 0:
        raise SystemExit("log_reading: nothing was read")
    return Cost(time.perf_counter() - wall, time.process_time() - cpu)


def main() -> int:
    """Measure, print and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--publish", type=Path, metavar="DOCS", help="write numbers and section below this folder")
    parser.add_argument("--size-mb", type=float, default=SIZE_MB, help="size of the log that is timed")
    parser.add_argument("--memory-sizes-mb", type=float, nargs="*", default=MEMORY_SIZES_MB, help="sizes for peak memory")
    parser.add_argument("--repeats", type=int, default=3, help="runs of which the fastest counts")
    arguments = parser.parse_args()
    os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        memory = memory_rows(folder, arguments.memory_sizes_mb)  # first: children must not start with our peak
        bombs = bomb_rows(folder)
        from benchmarks.mixed_logs import write_mixed_log

        path = folder / "mixed.mcap"
        num_messages = write_mixed_log(path, arguments.size_mb)
        rows = compare(path, arguments.repeats)
        tables = {
            "log_reading": rows + other_forms(folder, arguments.repeats),
            "log_reading_shares": share_rows(path, arguments.repeats, rows[0]["theirs_cpu_s"]),
            "log_reading_memory": memory, "log_reading_bombs": bombs,
        }  # fmt: skip
        size_mb = path.stat().st_size / 1e6
    facts = publishing.facts_of("log_reading") | {
        "num_messages": num_messages, "size_mb": size_mb, "num_repeats": arguments.repeats, "other_forms_mb": OTHER_FORMS_MB,
    }  # fmt: skip
    publishing.publish(Measurement("log_reading", facts, tables), section, arguments.publish)
    return 0


def section(measured: Measurement) -> str:
    """Ratios of processor time, memory, and files that lie about themselves."""
    heads = ["log", "what", "times as fast"]
    lines = [[row["log"], row["what"], f"{row['cpu_ratio']:.1f}"] for row in measured.rows()]
    largest = max(measured.rows("memory"), key=lambda row: row["size_mb"] or 0)
    bombs = "; ".join(f"{row['file']}: {row['peak_mb']:.0f} MB, {row['outcome']}" for row in measured.rows("bombs"))
    facts = measured.facts
    text = (
        f"{facts['num_messages']} messages, {facts['size_mb']:.0f} MB. Peak memory of checking and reading a log of "
        f"{largest['size_mb'] / 1000:.0f} GB: {largest['peak_mb']:.0f} MB; of opening small files that declare what they do "
        f"not hold: {bombs}."
    )
    return f"{publishing.table(heads, lines)}\n\n{text}"


if __name__ == "__main__":
    sys.exit(main())
