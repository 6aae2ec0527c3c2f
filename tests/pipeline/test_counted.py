"""One agent, two agents."""

import re
from pathlib import Path

import pytest

from pipeline.counted import counted, told

SOURCES = sorted((Path(__file__).resolve().parents[2] / "pipeline").rglob("*.py"))


@pytest.mark.parametrize(
    ("number", "words", "told"),
    [
        (0, ("agent",), "0 agents"),
        (1, ("agent",), "1 agent"),
        (2, ("agent",), "2 agents"),
        (1, ("detection is", "detections are"), "1 detection is"),
        (5, ("detection is", "detections are"), "5 detections are"),
    ],
)
def test_what_follows_a_number_fits_it(number: int, words: tuple[str, ...], told: str) -> None:
    assert counted(number, *words) == told


def test_what_is_told_of_one_is_in_the_singular() -> None:
    many = "positions are off the earth and were skipped"
    assert told(2, many) == f"2 {many}" and told(1, many) == "1 position is off the earth and was skipped"
    assert told(1, "messages cannot be decoded") == "1 message cannot be decoded"


def test_no_line_says_1_agents() -> None:
    """What is told of a log and of a run goes through `counted`."""
    plain = re.compile(r"\{[^{}]*\} (?:more )?(?:agents|windows|things|targets|messages belong|detections (?:are|do))\b")
    for path in SOURCES:
        if {"extract", "inspect", "batch"} & {*path.parts} or path.stem.endswith("_words"):
            assert not plain.search(path.read_text(encoding="utf-8")), path
