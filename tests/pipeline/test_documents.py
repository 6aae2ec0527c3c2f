"""Whatever is wrong with a text from outside is a ValueError."""

import pytest

from pipeline.documents import parse_json, parse_toml


def test_values_come_through():
    assert parse_json('{"a": [1, null]}') == {"a": [1, None]} and parse_json(b"2") == 2
    assert parse_toml("a = [1]\n[b]\nc = 'x'") == {"a": [1], "b": {"c": "x"}}


@pytest.mark.parametrize("depth", [1, 10_000, 100_000])
def test_nesting_without_end_is_a_value_error(depth):
    deep = "[" * depth
    with pytest.raises(ValueError):
        parse_json(deep)
    with pytest.raises(ValueError):
        parse_toml(f"a = {deep}")


def test_deep_but_sound_nesting_says_what_is_wrong():
    deep = "[" * 50_000 + "]" * 50_000
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(deep)
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_toml(f"a = {deep}")
