"""Compressed bytes of a chunk, of a message or of a whole file, which may be several frames behind each other.

Both formats allow that, and frames to be skipped among them. No more is unpacked than was asked for, whatever frames declare;
errors are those of the libraries.
"""

from io import BytesIO
from typing import Final

import lz4.frame
import zstandard

ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
"""How a zstd frame begins that is not to be skipped."""
MAX_MESSAGE_BYTES: Final = 2**26
"""Largest message that is unpacked by itself."""


def unpack_zstd(data: bytes | memoryview, max_bytes: int, is_cut: bool = False) -> bytes:
    """What the frames hold, up to `max_bytes` and one more, by which the caller sees that there is more.

    Of a frame that is known to be cut off, what is whole of it.
    """
    if not is_cut and zstandard.frame_content_size(data) == max_bytes:  # what recorders write, in the fastest way
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=max_bytes)
    return zstandard.ZstdDecompressor().stream_reader(BytesIO(data), read_across_frames=True).read(max_bytes + 1)


def unpack_message(data: bytes) -> bytes:
    """A message that is compressed by itself, as one zstd frame; ValueError where it is larger than the limit."""
    declared = zstandard.frame_content_size(data)
    unpacked = unpack_zstd(data, declared if 0 <= declared < MAX_MESSAGE_BYTES else MAX_MESSAGE_BYTES)
    if len(unpacked) > MAX_MESSAGE_BYTES:
        raise ValueError(f"it is compressed and larger than the limit of {MAX_MESSAGE_BYTES} bytes")
    return unpacked


def unpack_lz4(data: bytes | memoryview, max_bytes: int) -> bytes:
    """As `unpack_zstd`; a frame that is cut off gives what is whole of it."""
    frame, view = lz4.frame.create_decompression_context(), memoryview(data)
    parts, num_bytes, place = [], 0, 0
    while place < len(view) and num_bytes <= max_bytes:
        part, num_read, is_over = lz4.frame.decompress_chunk(frame, view[place:], max_length=max_bytes + 1 - num_bytes)
        if num_read == 0 and not part:
            break
        parts.append(part)
        num_bytes += len(part)
        place += num_read
        if is_over:
            lz4.frame.reset_decompression_context(frame)
    return parts[0] if len(parts) == 1 else b"".join(parts)
