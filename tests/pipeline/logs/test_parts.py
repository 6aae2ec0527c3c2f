import pytest

from pipeline.logs import parts
from pipeline.logs.parts import group_parts, missing_parts, mission_name, named_parts, recorded_parts

METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  relative_file_paths:
    - {}
  duration:
    nanoseconds: 1
  files:
    - path: other.mcap
"""


@pytest.fixture
def bag(tmp_path):
    def make(folder: str, present: list[str], named: list[str]):
        path = tmp_path / folder
        path.mkdir()
        for name in present:
            (path / name).write_bytes(b"")
        if named:
            (path / "metadata.yaml").write_text(METADATA.format("\n    - ".join(named)))
        return path

    return make


def test_folder_stands_for_its_parts_in_the_order_of_the_recording(bag):
    names = [f"bag_{i}.mcap" for i in range(11)]
    folder = bag("bag", sorted(names), names)
    parts = tuple(folder / name for name in names)
    assert recorded_parts(folder) == parts
    assert group_parts([folder]) == [parts]
    assert group_parts(sorted(folder.glob("*.mcap"))) == [parts]  # where bag_10 comes before bag_2
    assert group_parts([folder, *parts]) == [parts]


def test_a_selection_of_parts_is_one_mission(bag):
    folder = bag("bag", ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"], ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"])
    chosen = (folder / "bag_1.mcap", folder / "bag_2.mcap")
    assert group_parts(chosen[::-1]) == [chosen]
    assert missing_parts(chosen) == ()  # left out on purpose


def test_names_alone_join_nothing(bag):
    folder = bag("logs", ["run_0.mcap", "run_1.mcap"], [])
    paths = [folder / "run_1.mcap", folder / "run_0.mcap"]
    assert group_parts([*paths, paths[0]]) == [(paths[0],), (paths[1],)]
    assert group_parts([folder]) == [(folder,)] and group_parts([]) == []


def test_missions_keep_the_order_in_which_they_are_given(bag):
    one = bag("one", ["one_0.mcap", "one_1.mcap"], ["one_0.mcap", "one_1.mcap"])
    two = bag("two", ["two_0.mcap", "alone.mcap"], ["two/two_0.mcap"])  # as old recorders wrote it
    groups = group_parts([two / "alone.mcap", one / "one_1.mcap", two, one / "one_0.mcap"])
    assert groups == [(two / "alone.mcap",), (one / "one_0.mcap", one / "one_1.mcap"), (two / "two_0.mcap",)]


def test_parts_that_are_gone_are_named(bag):
    folder = bag("bag", ["bag_0.mcap", "bag_2.mcap"], ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"])
    (parts,) = group_parts([folder])
    assert parts == (folder / "bag_0.mcap", folder / "bag_2.mcap")
    assert missing_parts(parts) == (folder / "bag_1.mcap",)
    assert missing_parts([folder / "other.mcap"]) == ()


@pytest.mark.parametrize("text", ["", "relative_file_paths:\n", "{", "relative_file_paths: [a.mcap]\n", "\x00"])
def test_metadata_that_names_nothing_leaves_files_alone(text, bag):
    folder = bag("bag", ["bag_0.mcap", "bag_1.mcap"], [])
    (folder / "metadata.yaml").write_text(text)
    paths = sorted(folder.glob("*.mcap"))
    assert group_parts(paths) == [(path,) for path in paths]


def test_name_of_a_mission(tmp_path):
    assert mission_name([tmp_path / "run_0.mcap"]) == "run_0"
    assert mission_name([tmp_path / "run_0.mcap", tmp_path / "run_1.mcap"]) == "run"
    assert mission_name([tmp_path / "morning.mcap", tmp_path / "noon.mcap"]) == "morning"
    assert mission_name([tmp_path / "a_0.mcap", tmp_path / "b_1.mcap"]) == "a_0"


def test_a_name_that_cannot_be_appended_to_is_cut_and_stays_its_own(tmp_path):
    long = [tmp_path / f"{'n' * 230}{end}.mcap" for end in "ab"]
    names = [mission_name([path]) for path in long]
    assert len(set(names)) == 2 and all(len(name) == 209 and name.startswith("n" * 200 + "-") for name in names)
    assert mission_name([tmp_path / f"{'n' * 200}.mcap"]) == "n" * 200
    umlauts = mission_name([tmp_path / f"{'ü' * 115}.mcap"])
    assert umlauts.startswith("ü" * 100 + "-") and len(umlauts) == 109
    assert len(mission_name([tmp_path / f"n{'ü' * 115}.mcap"]).encode()) <= 209  # the cut is between letters


def test_metadata_is_read_once_for_all_parts(bag, monkeypatch):
    names = [f"bag_{i}.mcap" for i in range(300)]
    folder = bag("bag", names, names)
    opened = []
    text = (folder / "metadata.yaml").read_text()
    monkeypatch.setattr(parts, "named_parts", lambda found: opened.append(found) or named_parts(found))
    assert len(group_parts([folder / name for name in names])[0]) == 300
    assert opened == [text]
    assert missing_parts([folder / name for name in names]) == () and opened == [text] * 2
