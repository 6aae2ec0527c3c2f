"""The strict configuration reader: what it takes, and what it says about what it does not take."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from cadence.diffusion.settings import PlaceSampling
from cadence.errors import ConfigError
from pipeline.config import (
    config_as_dict,
    load_tables,
    load_toml,
    merge_overrides,
    parse_override,
    read_config,
    read_settings,
)
from pipeline.export.config import ExportConfig
from pipeline.forecast.stage import ForecastConfig
from pipeline.infer.config import InferConfig
from pipeline.train.config import TrainConfig


@dataclass(frozen=True)
class Inner:
    kind: Literal["a", "b"] = "a"
    ratio: float = 0.5

    def __post_init__(self) -> None:
        if self.ratio < 0:
            raise ValueError(f"ratio is {self.ratio}, expected at least 0; raise it")


@dataclass(frozen=True)
class Outer:
    name: str
    count: int = 3
    is_on: bool = False
    path: Path | None = None
    sizes_m: tuple[float, ...] = (1.0, 2.0)
    pair: tuple[int, str] = (1, "x")
    table: dict[str, int] = field(default_factory=dict)
    inner: Inner = Inner()
    rows: tuple[Inner, ...] = ()


def test_values_reach_their_fields_with_their_types():
    config = read_config(
        Outer,
        {
            "name": "n", "count": 4, "is_on": True, "path": "a/b", "sizes_m": [1, 2.5], "pair": [7, "y"], "table": {"k": 1},
            "inner": {"kind": "b", "ratio": 1}, "rows": [{"ratio": 2.0}, {}],
        },
    )  # fmt: skip
    assert config == Outer(
        "n", 4, True, Path("a/b"), (1.0, 2.5), (7, "y"), {"k": 1}, Inner("b", 1.0), (Inner(ratio=2.0), Inner())
    )
    assert isinstance(config.inner.ratio, float) and all(isinstance(size, float) for size in config.sizes_m)


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        ({}, "key 'name' is missing"),
        ({"name": "n", "cuont": 1}, r"unknown key 'cuont' \(did you mean 'count'\?\); known keys: name, count, is_on"),
        ({"name": 1}, r"config\.name: expected a text, got 1"),
        ({"name": "n", "count": 1.5}, r"config\.count: expected a whole number, got 1\.5"),
        ({"name": "n", "count": True}, r"config\.count: expected a whole number, got True"),
        ({"name": "n", "is_on": 1}, r"config\.is_on: expected true or false, got 1"),
        ({"name": "n", "sizes_m": [1, "x"]}, r"config\.sizes_m\[1\]: expected a number, got 'x'"),
        ({"name": "n", "sizes_m": [float("nan")]}, r"config\.sizes_m\[0\]: expected a number, got nan"),
        ({"name": "n", "pair": [1]}, r"config\.pair: expected tuple"),
        ({"name": "n", "inner": {"kind": "c"}}, r"config\.inner\.kind: 'c' is not one of a, b"),
        ({"name": "n", "inner": {"ratio": -1}}, r"config\.inner: ratio is -1\.0"),
        ({"name": "n", "inner": 3}, r"config\.inner: expected a table, got 3"),
        ({"name": "n", "rows": [{"nope": 1}]}, r"config\.rows\[0\]: unknown key 'nope'; known keys: kind, ratio"),
    ],
)
def test_what_does_not_fit_is_named_with_its_place(tables, says):
    with pytest.raises(ConfigError, match=says) as caught:
        read_config(Outer, tables)
    assert "\n" not in str(caught.value) and caught.value.exit_code == 4


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("a=1", ("a",), 1),
        ("a.b = true", ("a", "b"), True),
        ("a.b=[1, 2]", ("a", "b"), [1, 2]),
        ("a.b=plain/path.toml", ("a", "b"), "plain/path.toml"),
        ('a.b="quoted = 3"', ("a", "b"), "quoted = 3"),
        ("a.b=x=y", ("a", "b"), "x=y"),
        ("a.b=2026-01-01", ("a", "b"), "2026-01-01"),
        ("a.b=", ("a", "b"), ""),
    ],
)
def test_overrides_are_toml_or_bare_strings(text, path, value):
    assert parse_override(text) == (path, value)


@pytest.mark.parametrize("text", ["a", "=1", " =1"])
def test_override_without_key_or_value_is_refused(text):
    with pytest.raises(ConfigError, match="expected KEY=VALUE"):
        parse_override(text)


def test_overrides_win_and_leave_the_input_alone():
    tables = {"infer": {"count": 1, "inner": {"kind": "a"}}}
    merged = merge_overrides(tables, ["infer.inner.kind=b", "infer.count=2", "infer.count=3", "export.x=1"])
    assert merged == {"infer": {"count": 3, "inner": {"kind": "b"}}, "export": {"x": 1}}
    assert tables == {"infer": {"count": 1, "inner": {"kind": "a"}}}


def test_override_below_a_value_is_refused():
    with pytest.raises(ConfigError, match="'count' is a value, not a table"):
        merge_overrides({"infer": {"count": 1}}, ["infer.count.deep=1"])


def test_file_with_unknown_table_names_the_known_ones(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[infre]\nx = 1\n")
    with pytest.raises(
        ConfigError, match=r"c\.toml: unknown table 'infre' \(did you mean 'infer'\?\); known tables: ingest, extract"
    ):
        load_tables(path)


def test_table_given_as_value_is_refused():
    with pytest.raises(ConfigError, match="'infer' is a table"):
        load_tables(None, ["infer=3"])


def test_toml_errors_name_file_and_line(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[infer]\nx = = 1\n")
    with pytest.raises(ConfigError, match=r"c\.toml: not valid TOML: .*line 2"):
        load_toml(path)
    with pytest.raises(ConfigError, match=r"missing\.toml: cannot read"):
        load_toml(tmp_path / "missing.toml")
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="not a text, so no configuration"):
        load_toml(path)


def test_config_as_dict_reads_back_to_the_same_config():
    config = Outer("n", path=Path("p"), rows=(Inner("b"),), table={"k": 2})
    assert read_config(Outer, config_as_dict(config)) == config


def test_nesting_without_end_is_one_short_line(tmp_path):
    path = tmp_path / "deep.toml"
    path.write_text("a = " + "[" * 20_000 + "]" * 20_000)
    with pytest.raises(ConfigError, match=r"deep\.toml: not valid TOML: nested too deeply; correct the file"):
        load_tables(path)
    with pytest.raises(ConfigError) as caught:
        read_config(Outer, {"name": "n", "count": parse_override("count=" + "[" * 20_000)[1]})
    assert len(str(caught.value)) < 200


def test_what_was_meant_is_said_also_where_it_stands_in_a_table_inside():
    with pytest.raises(ConfigError, match=r"unknown key 'ratio' \(did you mean 'inner\.ratio'\?\); known keys: name"):
        read_config(Outer, {"name": "n", "ratio": 1})
    with pytest.raises(ConfigError, match=r"unknown key 'zzz'; known keys: name"):
        read_config(Outer, {"name": "n", "zzz": 1})


@pytest.mark.parametrize("number", ["1e300", "-1e10", "1e-300", str(10**30), str(2**63 - 1)])
def test_numbers_that_no_setting_can_mean_are_refused(number):
    with pytest.raises(ConfigError, match=r"infer\.grid\.step_s: \S+ is beyond what it can mean, 1e-09 to 1e\+09; correct it"):
        read_settings(Outer, {"rows": [{"ratio": 1.0}], "grid": {"step_s": parse_override(f"a={number}")[1]}}, "infer")
    with pytest.raises(ConfigError, match=r"rows\[1\]\.ratio"):
        read_settings(Outer, {"rows": [{"ratio": 1.0}, {"ratio": parse_override(f"a={number}")[1]}]}, "")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_no_number_is_refused_but_for_limits_without_limit(value):
    with pytest.raises(ConfigError, match=r"^infer\.grid\.step_s: \S+ is nothing that it can mean; give a number$"):
        read_settings(Outer, {"grid": {"step_s": value}}, "infer")
    if value > 0:
        assert read_settings(ExportConfig, {"max_scene_mb": value}, "export").max_scene_mb == value


def test_numbers_at_the_limits_and_seeds_are_settings():
    config = read_settings(Outer, {"name": "n", "count": 10**9, "inner": {"ratio": 1e9}, "sizes_m": [1e-9, 0]}, "")
    assert config.count == 10**9 and config.inner.ratio == 1e9 and config.sizes_m == (1e-9, 0.0)
    with pytest.raises(ConfigError, match="unknown key 'seed'"):  # its size was no reason to refuse it
        read_settings(Outer, {"seed": 2**63 - 1}, "")


@dataclass(frozen=True)
class Renamed:
    kind: Literal["place", "bank"] = field(default="bank", metadata={"older_values": {"scene": "place"}})
    inner: Inner = field(default=Inner(), metadata={"older_name": "outer"})


def test_what_was_called_otherwise_is_still_read():
    table = {"kind": "scene", "outer": {"ratio": 2.0}}
    assert read_config(Renamed, table) == Renamed("place", Inner(ratio=2.0))
    assert table == {"kind": "scene", "outer": {"ratio": 2.0}}
    with pytest.raises(ConfigError, match=r"config: 'outer' is the older name of 'inner'; give one of the two"):
        read_config(Renamed, {"inner": {}, "outer": {}})
    with pytest.raises(ConfigError, match=r"config\.kind: 'scenes' is not one of place, bank"):
        read_config(Renamed, {"kind": "scenes"})


def test_tables_of_0_3_are_read():
    assert read_config(InferConfig, {"scene": {"num_steps": 3}}) == InferConfig(place=PlaceSampling(num_steps=3))
    assert read_config(ForecastConfig, {"scene": {"num_steps": 3}}).place == PlaceSampling(num_steps=3)
    train = read_config(TrainConfig, {"preset": "scene", "scene": {"few_steps": 3}})
    assert (train.preset, train.place.few_steps) == ("place", 3)
    assert read_config(InferConfig, {"association": {"num_ways": 7}}).association.num_associations == 7
