#!/usr/bin/env bash
# mcap 1.6.0 (Python): of a chunk that is several zstd frames only the first is read, and the rest is missed without a word.
#
# Behaviour. A chunk's records are handed to zstandard.decompress, which stops behind the first frame of its input. Where that frame
# ends with a record, the reader takes what it has for the whole chunk: messages are gone, nothing is raised, and the summary goes on
# counting all of them. Only validate_crcs=True, which is off unless asked for, notices. Compressed data of Zstandard is one or
# more frames, and their contents follow each other (RFC 8878, sections 3 and 3.1); the registry of MCAP names zstd without any
# restriction. Frames come about where a writer compresses in pieces or in parallel, as pzstd does. Of zstandard itself it is known
# (python-zstandard, issue 59); what it does to a recording is not.
#
# Input. A chunk of forty messages, whose records are compressed as two frames of twenty; lengths and checksums are right.
#
# Output seen:
#   mcap 1.6.0, zstandard 0.25.0
#   frames joined by zstandard's own reader across frames: the stated length and the stated checksum
#   one frame a chunk: 40 of 40 messages
#   two frames a chunk: 20 of 40 messages, none of which is said to be missing
#   the same without the index: 20 of 40 messages
#   as stated
#
# Exit: 0 the behaviour is as stated, 1 it is another one, 2 the packages could not be installed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv" || exit 2
"$folder/venv/bin/python" -m pip install --quiet mcap==1.6.0 zstandard==0.25.0 lz4==4.4.5 >"$folder/pip.log" 2>&1 || {
  tail -n 3 "$folder/pip.log" >&2
  exit 2
}

cat > "$folder/probe.py" <<'PROBE'
import importlib.metadata
import io
import struct
import sys
import zlib

import zstandard
from mcap import writer as writing
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

NUM_MESSAGES, MESSAGE = 40, 0x05


class Frames:
    """Compresses as zstandard does, but in frames of equally many messages, each a record: a byte, a length, and its content."""

    def __init__(self, num_frames):
        self.num_frames = num_frames

    def compress(self, records):
        ends, place = [], 0
        while place < len(records):
            kind, length = struct.unpack_from("<BQ", records, place)
            place += 9 + length
            ends += [place] if kind == MESSAGE else []
        cuts = [0, *(ends[(number * len(ends)) // self.num_frames - 1] for number in range(1, self.num_frames + 1))]
        return b"".join(zstandard.compress(records[first:last]) for first, last in zip(cuts, cuts[1:]))


def recording(num_frames):
    file, writing.zstandard = io.BytesIO(), Frames(num_frames)
    writer = writing.Writer(file, chunk_size=1 << 20)
    writer.start()
    schema = writer.register_schema("Count", "jsonschema", b'{"type": "object"}')
    channel = writer.register_channel("/count", "json", schema)
    for number in range(NUM_MESSAGES):
        writer.add_message(channel, number, b'{"number": %d}' % number, number, number)
    writer.finish()
    writing.zstandard = zstandard
    return file.getvalue()


def num_read(reader):
    return sum(1 for _ in reader.iter_messages())


one, two = recording(1), recording(2)
(chunk,) = (record for record in StreamReader(io.BytesIO(two), emit_chunks=True).records if isinstance(record, Chunk))
whole = zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True).read()
is_sound = len(whole) == chunk.uncompressed_size and zlib.crc32(whole) == chunk.uncompressed_crc
statistics = make_reader(io.BytesIO(two)).get_summary().statistics.message_count
found = num_read(make_reader(io.BytesIO(one))), num_read(make_reader(io.BytesIO(two))), num_read(NonSeekingReader(io.BytesIO(two)))
versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("mcap", "zstandard"))
print(versions)
length = "the stated length and the stated checksum" if is_sound else "another length or checksum"
print(f"frames joined by zstandard's own reader across frames: {length}")
print(f"one frame a chunk: {found[0]} of {statistics} messages")
print(f"two frames a chunk: {found[1]} of {statistics} messages, none of which is said to be missing")
print(f"the same without the index: {found[2]} of {statistics} messages")
is_as_stated = is_sound and statistics == NUM_MESSAGES and found == (40, 20, 20)
print("as stated" if is_as_stated else "the behaviour is another one")
sys.exit(0 if is_as_stated else 1)
PROBE
"$folder/venv/bin/python" "$folder/probe.py"
