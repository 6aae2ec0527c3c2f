import dataclasses
import tomllib

import numpy as np
import pytest
from fixtures.recorder import recording
from fixtures.small_logs import detection, write_log

from cadence.errors import InputError
from pipeline.inspect.info import describe_log, render


def write(tmp_path, data):
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    return path


def test_real_flight_is_described(shared_data):
    text = render(describe_log(shared_data / "flights" / "cubs2_cub_stabilize.mcap"))
    assert "/cub1/pose" in text and "geometry_msgs/msg/PoseStamped" in text and "99.5 Hz" in text and "qualisys" in text
    assert "2025-11-13T22:32:49" in text and "0:03:18" in text and "21258 on 2 channels" in text
    assert "Health: sound" in text and "no checksums" in text


@pytest.mark.parametrize("name", ["maritime/solent_ais_known.mcap", "prison_reference/high/p_high_0000.mcap"])
def test_settings_can_be_pasted(name, shared_data):
    description = describe_log(shared_data / name)
    text = render(description)
    lines = tomllib.loads(text[text.index("[[extract") :])
    assert lines["extract"]["detections"] and lines["extract"]["truth"]
    assert set(description.roles.values()) >= {"detections", "truth"}
    for role in ("detections", "truth"):
        assert any(line.startswith("/") and role in line for line in text.splitlines())


def test_log_without_known_channels_shows_how_to_name_them(tmp_path):
    description = describe_log(write(tmp_path, recording()))
    text = render(description)
    assert "No channel looks like detections" in text and "[[extract.detections]]" in text
    assert "/a     Item" in text and "3.33 Hz" in text and "metadata  mission" in text


def test_damage_is_told(tmp_path):
    whole = recording()
    damaged = bytearray(whole)
    damaged[damaged.index(b"zstd") + 20] ^= 0xFF
    text = render(describe_log(write(tmp_path, bytes(damaged))))
    assert "DAMAGED" in text and "Lost at byte" in text and "Messages are missing in 1 time spans" in text
    text = render(describe_log(write(tmp_path, whole[:-20])))
    assert "all messages can be read, but" in text


def test_log_without_messages_is_described(tmp_path):
    text = render(describe_log(write(tmp_path, recording(num_messages=0))))
    assert "0 on 3 channels" in text and "1970" not in text


def test_description_is_plain_data(tmp_path):
    described = dataclasses.asdict(describe_log(write(tmp_path, recording())))
    assert [channel["num_messages"] for channel in described["channels"]] == [40, 40, 40]


def test_what_is_no_log_is_refused(tmp_path):
    with pytest.raises(InputError, match="not an MCAP"):
        describe_log(write(tmp_path, b"x" * 50))


def test_folder_of_a_split_recording_is_one_log(tmp_path):
    for name in ("bag_0.mcap", "bag_1.mcap"):
        (tmp_path / name).write_bytes(recording())
    (tmp_path / "metadata.yaml").write_text("relative_file_paths:\n  - bag_0.mcap\n  - bag_1.mcap\n")
    described = describe_log(tmp_path)
    assert [channel.num_messages for channel in described.channels] == [80, 80, 80]


def test_accuracy_that_is_not_stated(tmp_path):
    noisy = np.random.default_rng(3).normal(0.0, 4.0, (200, 2)) + [[6.0 * i, 0.0] for i in range(200)]
    log = [detection(float(i), *place, agent_id="a") for i, place in enumerate(noisy.tolist())]
    text = render(describe_log(write_log(tmp_path / "log.mcap", log)))
    assert (
        "Accuracy of the detections, where messages do not state it:\n  /detections: no accuracy is stated; a standard" in text
    )
