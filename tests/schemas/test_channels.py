from pathlib import Path

import pytest
from google.protobuf import descriptor_pb2

from schemas import channels
from schemas.channels import Channel, message_class

DIRECTORY = Path(channels.__file__).parent


def test_committed_descriptors_are_those_of_the_proto_file(tmp_path):
    protoc = pytest.importorskip("grpc_tools.protoc", reason="grpcio-tools is not installed (development only)")
    built = tmp_path / "built.binpb"
    well_known = Path(protoc.__file__).with_name("_proto")
    arguments = ["", f"-I{DIRECTORY}", f"-I{well_known}", "--include_imports", f"--descriptor_set_out={built}", "cadence.proto"]
    assert protoc.main(arguments) == 0
    read = descriptor_pb2.FileDescriptorSet.FromString
    assert read(built.read_bytes()) == read((DIRECTORY / "cadence.binpb").read_bytes())


def test_descriptors_hold_their_imports_first():
    files = descriptor_pb2.FileDescriptorSet.FromString((DIRECTORY / "cadence.binpb").read_bytes()).file
    assert [file.name for file in files] == ["google/protobuf/timestamp.proto", "cadence.proto"]


@pytest.mark.parametrize(
    "name", ["Hypotheses", "AgentHypotheses", "Agents", "AgentState", "Detection", "Association", "MissionHypotheses"]
)
def test_messages_are_found(name):
    message = message_class(f"cadence.{name}")()
    assert message.DESCRIPTOR.full_name == f"cadence.{name}"


def test_field_numbers_are_never_changed():
    fields = {
        field.name: field.number
        for name in ("Hypotheses", "AgentHypotheses")
        for field in message_class(f"cadence.{name}").DESCRIPTOR.fields
    }
    released = {"origin_ns": 5, "step_ns": 6, "origin_index": 7, "num_steps": 8, "hypothesis": 9, "weight": 10, "agents": 11}
    released |= {"datum_x_m": 7, "datum_y_m": 8, "position_m": 9, "latitude_deg": 12, "longitude_deg": 13}
    assert released.items() <= fields.items()


def test_topics_are_unique_and_ours():
    found = [value for value in vars(channels).values() if isinstance(value, Channel)]
    assert len({channel.topic for channel in found}) == len(found) == 15
    assert all(channel.topic.startswith("/cadence/") for channel in found)


@pytest.mark.parametrize(("agent_id", "word"), [("T0", "T0"), ("a/b c", "a_b_c"), ('"x"', "_x_"), ("Ü-1", "Ü-1")])
def test_agents_make_one_part_of_a_topic(agent_id, word):
    assert channels.fix_channel(agent_id).topic == f"/cadence/fix/{word}"
    assert channels.detection_fix_channel(agent_id).topic == f"/cadence/detection_fix/{word}"


def test_detections_of_unknown_origin_have_a_topic():
    assert channels.detection_fix_channel(None).topic == "/cadence/detection_fix/unknown"
