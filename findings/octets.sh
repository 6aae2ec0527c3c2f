#!/usr/bin/env bash
# rosbags 0.11.9 and mcap-ros2-support 0.6.0 disagree about a `byte` and a `char` of ROS 2: each takes another of them for signed.
#
# Behaviour. To ROS 2 both are octets without a sign: its adapter makes `octet` of a byte and `uint8` of a char when it turns a .msg
# into IDL (rosidl_adapter/msg/__init__.py), and the C++ fields are unsigned. rosbags reads a byte as int8, also in arrays and where
# IDL says octet, and refuses to write one of 128 and more; it reads a char rightly. mcap-ros2-support reads a byte rightly and a
# char as int8. The same message thus says 200 or -56, by the field and by the reader; nothing is raised. In ROS 1, whose byte is
# an int8 by its definition, rosbags is right.
#
# Input. One CDR message, byte for byte, of a definition with a byte, a char, a uint8 and an array of bytes, all 200.
#
# Output seen:
#   rosbags 0.11.9, mcap-ros2-support 0.6.0
#   rosbags:           byte -56, char 200, uint8 200, byte[2] [-56, -56]
#   mcap-ros2-support: byte 200, char -56, uint8 200, byte[2] [200, 200]
#   rosbags, octet of IDL: -56
#   rosbags, to write a byte of 200: error
#   as stated
#
# Exit: 0 the behaviour is as stated, 1 it is another one, 2 the packages could not be installed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv" || exit 2
"$folder/venv/bin/python" -m pip install --quiet rosbags==0.11.9 mcap-ros2-support==0.6.0 >"$folder/pip.log" 2>&1 || {
  tail -n 3 "$folder/pip.log" >&2
  exit 2
}

cat > "$folder/probe.py" <<'PROBE'
import importlib.metadata
import io
import sys

from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

NAME = "octets/msg/Plot"
DEFINITION = "byte a\nchar b\nuint8 c\nbyte[2] d\n"
IDL = "module octets { module msg { struct Other { octet a; }; }; };"
LITTLE_ENDIAN = b"\x00\x01\x00\x00"
DATA = LITTLE_ENDIAN + bytes([200] * 5)


def by_mcap_ros2():
    """The message as it is read out of a log."""
    file = io.BytesIO()
    writer = Writer(file)
    writer.start("ros2")
    schema = writer.register_schema(NAME, "ros2msg", DEFINITION.encode())
    writer.add_message(writer.register_channel("/plots", "cdr", schema), 0, DATA, 0)
    writer.finish()
    log = io.BytesIO(file.getvalue())
    return next(iter(make_reader(log, decoder_factories=[DecoderFactory()]).iter_decoded_messages())).decoded_message


def values(message):
    return [int(message.a), int(message.b), int(message.c), [int(value) for value in message.d]]


def said(found):
    return f"byte {found[0]}, char {found[1]}, uint8 {found[2]}, byte[2] {found[3]}"


store = get_typestore(Stores.ROS2_HUMBLE)
store.register(get_types_from_msg(DEFINITION, NAME) | get_types_from_idl(IDL))
one, other = values(store.deserialize_cdr(DATA, NAME)), values(by_mcap_ros2())
octet = int(store.deserialize_cdr(DATA[:5], "octets/msg/Other").a)
try:
    written = bytes(store.serialize_cdr(store.types["octets/msg/Other"](a=200), "octets/msg/Other")).hex()
except Exception as error:
    written = type(error).__name__
print(", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("rosbags", "mcap-ros2-support")))
print(f"rosbags:           {said(one)}")
print(f"mcap-ros2-support: {said(other)}")
print(f"rosbags, octet of IDL: {octet}")
print(f"rosbags, to write a byte of 200: {written}")
is_as_stated = one == [-56, 200, 200, [-56, -56]] and other == [200, -56, 200, [200, 200]] and octet == -56 and written == "error"
print("as stated" if is_as_stated else "the behaviour is another one")
sys.exit(0 if is_as_stated else 1)
PROBE
"$folder/venv/bin/python" "$folder/probe.py"
