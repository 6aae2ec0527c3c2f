"""Mission logs: what an MCAP holds, how sound it is, and its messages in log-time order, in bounded memory.

`open_log` checks the whole file once (see `recordings`), so the health of a log is known before the first message is used;
`open_parts` makes one mission of a recording in several files; `reopen` trusts the index of what was checked before.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cadence.arrays import Int64s
from cadence.errors import InputError
from pipeline.logs.channels import Batch as Batch
from pipeline.logs.channels import Channel as Channel
from pipeline.logs.channels import RawMessage as RawMessage
from pipeline.logs.compression import ZSTD_MAGIC
from pipeline.logs.foreign import HEAD_BYTES, kind_of
from pipeline.logs.health import Health as Health
from pipeline.logs.health import health_of, united_health
from pipeline.logs.health import utc as utc
from pipeline.logs.indexed import plan_by_index
from pipeline.logs.packed import in_proportion, unpacked
from pipeline.logs.parts import missing_parts, mission_name
from pipeline.logs.plan import Plan
from pipeline.logs.recordings import scan_log
from pipeline.logs.records import MAGIC, MAX_TIME_NS, TEXT_MAGIC, parse_metadata
from pipeline.logs.timeline import Selection, Source, Timeline, read_span, reading
from pipeline.logs.uniting import unite

OnBytes = Callable[[int], object]


@dataclass(frozen=True)
class MissionLog:
    """A log that has been checked once; messages are read from its files on request.

    path              the file; the first one where a mission has several
    channels          their ids are those of the file; where there are several files, unique in the mission
    start_ns, end_ns  log times of the first and the last message (both 0 without messages)
    """

    path: Path
    size_bytes: int
    channels: tuple[Channel, ...]
    start_ns: int
    end_ns: int
    health: Health
    library: str = ""
    _sources: tuple[Source, ...] = field(default=(), repr=False)

    @property
    def parts(self) -> tuple[Path, ...]:
        """The files of the mission that can be read, in their order."""
        return tuple(dict.fromkeys(source.path for source in self._sources))

    @property
    def num_recordings(self) -> int:
        """How many recordings its files hold; more than files where some were joined, one behind the other."""
        return len(self._sources)

    @property
    def name(self) -> str:
        """What the mission is called: the stem of its file, or what the names of its parts have in common."""
        return mission_name(self.parts or (self.path,))

    def messages(
        self,
        topics: Collection[str] | None = None,
        on_bytes: OnBytes | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        on_back: Callable[[], object] | None = None,
    ) -> Iterator[RawMessage]:
        """All messages of `topics` (None: of every topic) in log-time order, then in the order of the files.

        Only those with start_ns <= log time < end_ns, where these are given; other chunks are not read. Memory: one
        chunk, and a bounded part of those that overlap it in time. `on_bytes` is called with the number of bytes done
        since the last call; the calls add up to `size_bytes`. `on_back` is called where they were not written by time.
        """
        return self._timeline(topics, on_bytes, start_ns, end_ns, on_back).messages()

    def written(self, topics: Collection[str] | None = None) -> tuple[Int64s, Int64s]:
        """Channel id [N] and log time [N] of all messages of `topics` in the order in which they were written."""
        return self._timeline(topics, None, None, None).written()

    def batches(
        self,
        topics: Collection[str] | None = None,
        on_bytes: OnBytes | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Batch]:
        """The messages of `messages` as columns, without an object a message: one batch a chunk and channel.

        Batches come by the first log time of their chunks; inside a batch messages are in order. Those of one channel
        overlap in time where the recorder's chunks do.
        """
        return self._timeline(topics, on_bytes, start_ns, end_ns).batches()

    def metadata(self) -> tuple[tuple[str, dict[str, str]], ...]:
        """Name and content of every Metadata record, in the order of the files."""
        found = []
        for source in self._sources:
            with reading(source.path) as file:
                for offset, length in source.metadata_spans:
                    record = parse_metadata(read_span(file, offset, length))
                    found.append((record.name, dict(record.metadata)))
        return tuple(found)

    def _timeline(
        self,
        topics: Collection[str] | None,
        on_bytes: OnBytes | None,
        start_ns: int | None,
        end_ns: int | None,
        on_back: Callable[[], object] | None = None,
    ) -> Timeline:
        wanted = [
            {number: channel for number, channel in source.channels.items() if topics is None or channel.topic in topics}
            for source in self._sources
        ]
        start = 0 if start_ns is None else max(0, start_ns)
        end = MAX_TIME_NS + 1 if end_ns is None else max(0, min(end_ns, MAX_TIME_NS + 1))
        return Timeline(self._sources, Selection(wanted, start, end), on_bytes, on_back)


def open_log(path: Path | str, on_bytes: OnBytes | None = None) -> MissionLog:
    """The log at `path`, every checksum checked; a damaged log opens too, and its health says what is lost.

    `on_bytes` is called as in `MissionLog.messages`. Raises `InputError` where there is no MCAP at `path`.
    """
    path = Path(path)
    sources, health, library = _checked(path, on_bytes)
    return _log_of(path, sources, health, library)


def open_parts(paths: Sequence[Path], on_bytes: OnBytes | None = None) -> MissionLog:
    """The recording whose parts lie at `paths` as one log: messages by time, channels of one topic and schema united.

    A part that is no log (recorders leave empty ones behind) and a part that `metadata.yaml` names but that is not there
    are named by the health as lost. Raises `InputError` where one of `paths` does not exist, or none of them is a log.
    """
    unread = [f"{path.name}: is named in {path.parent / 'metadata.yaml'}, but not there." for path in missing_parts(paths)]
    if not paths:
        raise InputError("a mission without parts; name at least one file")
    found: dict[Path, tuple[list[Source], Health, str]] = {}
    for path in paths:
        try:
            found[path] = _checked(path, on_bytes)
        except InputError as error:
            if not path.is_file() or (path == paths[-1] and not found):
                raise
            unread.append(f"{error}.")
            if on_bytes is not None:
                on_bytes(path.stat().st_size)
    sources = [source for each, _, _ in found.values() for source in each]
    first, (_, health, library) = next(iter(found.items()))
    if len(found) > 1 or unread:
        health = united_health([(path.name, health) for path, (_, health, _) in found.items()], unread)
    return _log_of(first, sources, health, library)


def reopen(paths: Sequence[Path], health: Health, on_bytes: OnBytes | None = None) -> MissionLog:
    """The log whose files were checked before with this `health`, and have not changed since (the caller knows by a hash).

    Sound files are planned by their indexes alone, without unpacking a chunk; others are checked again.
    """
    if not health.problems:
        plans = [plan for plan in map(plan_by_index, paths) if plan is not None]
        if len(plans) == len(paths) and sum(plan.counts().total() for plan in plans) == health.num_messages:
            sources = [_source_of(path, plan, plan.end) for path, plan in zip(paths, plans, strict=True)]
            return _log_of(paths[0], sources, health, plans[0].library)
    return open_parts(paths, on_bytes)


def _checked(path: Path, on_bytes: OnBytes | None) -> tuple[list[Source], Health, str]:
    """The recordings in a file, every checksum checked, its health, and who wrote it."""
    size = packed_size = _check_magic(path)
    try:
        plain = unpacked(path, in_proportion(on_bytes, packed_size, packed_size // 2))
        if plain != path:
            size = plain.stat().st_size
            on_bytes = in_proportion(on_bytes, size, packed_size - packed_size // 2)
        plans = scan_log(plain, size, on_bytes)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the disk") from error
    ends = [*(plan.begin for plan in plans[1:]), size]
    sources = [_source_of(path, plan, end - plan.begin) for plan, end in zip(plans, ends, strict=True)]
    return sources, health_of(plans), plans[0].library


def _source_of(path: Path, plan: Plan, size_bytes: int) -> Source:
    channels = {channel.id: channel for channel in _channels(plan)}
    blocks = tuple(block for block in plan.blocks if channels.keys() & block.num_messages.keys())
    return Source(path, size_bytes, blocks, channels, tuple(plan.metadata_spans))


def _log_of(path: Path, sources: Sequence[Source], health: Health, library: str) -> MissionLog:
    united, channels = unite(sources)
    blocks = [block for source in united for block in source.blocks]
    return MissionLog(
        path, sum(source.size_bytes for source in united), channels,
        start_ns=min((block.start_ns for block in blocks), default=0),
        end_ns=max((block.end_ns for block in blocks), default=0),
        health=health, library=library, _sources=united,
    )  # fmt: skip


def _check_magic(path: Path) -> int:
    """The size of the file, after a look at its first bytes."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the .mcap file inside it")
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
            size = file.seek(0, 2)
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found; check the path") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); check the permissions") from error
    if size == 0:
        raise InputError(f"{path}: is empty; nothing was recorded, or the copy failed")
    if not head.startswith((MAGIC, TEXT_MAGIC, ZSTD_MAGIC)):
        raise InputError(f"{path}: is not an MCAP file but {kind_of(path, head)}")
    return size


def _channels(plan: Plan) -> tuple[Channel, ...]:
    counts = plan.counts()
    channels = []
    for number, record in sorted(plan.channels.items()):
        schema = plan.schemas.get(record.schema_id)
        name, encoding, data = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        metadata = dict(record.metadata)
        channels.append(Channel(number, record.topic, record.message_encoding, name, encoding, data, counts[number], metadata))
    return tuple(channels)
