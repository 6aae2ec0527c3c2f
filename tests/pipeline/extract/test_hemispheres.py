"""Sources that lie near each other only when one of them is mirrored."""

from pathlib import Path

import pytest
from fixtures.small_logs import Row, fix
from test_extract import run


def contacts(name: str, latitude: float, longitude: float) -> list[Row]:
    return [fix(float(i), latitude + 1e-4 * i, longitude, f"/{name}/contacts/{name}") for i in range(20)]


@pytest.mark.parametrize(
    ("place", "word"),
    [
        ((11.6, 48.1), "latitude and longitude exchanged"),
        ((48.2, -11.7), "it on the other side of Greenwich"),
        ((-48.1, 11.6), "it on the other side of the equator"),
        ((-48.1, -11.6), "it on the other side of both"),
    ],
)
def test_one_source_that_is_mirrored(tmp_path: Path, place: tuple[float, float], word: str) -> None:
    found = run(tmp_path, [*contacts("a", 48.1, 11.6), *contacts("b", *place), *contacts("c", 48.3, 11.5)])
    (suspicion,) = found.summary["suspicions"]
    assert suspicion["subject"] == "/b/contacts/b" and f"with {word} it would lie near /a/contacts/a" in suspicion["seen"]
    sources = [{"topic": f"/{name}/contacts/{name}", "unit": "deg"} for name in "abc"]
    assert run(tmp_path, [*contacts("a", 48.1, 11.6), *contacts("b", *place), *contacts("c", 48.3, 11.5)],
               detections=sources).summary["suspicions"] == []  # fmt: skip


@pytest.mark.parametrize("place", [(48.1, 20.0), (0.1, -0.1), (-30.0, 60.0), (48.0, 11.9)])
def test_sources_that_are_far_apart_or_near(tmp_path: Path, place: tuple[float, float]) -> None:
    beside = (48.1, 11.6) if abs(place[0]) > 1 else (0.1, 0.1)
    assert run(tmp_path, [*contacts("a", *beside), *contacts("b", *place)]).summary["suspicions"] == []


def test_the_only_source_beside_a_datum_that_is_stated(tmp_path: Path) -> None:
    rows = contacts("a", 11.6, 48.1)
    (suspicion,) = run(tmp_path, rows, datum=(48.2, 11.5)).summary["suspicions"]
    assert "with latitude and longitude exchanged it would lie near extract.datum" in suspicion["seen"]
    assert suspicion["setting"].endswith("in its source")
    assert run(tmp_path, rows, datum=(11.5, 48.2)).summary["suspicions"] == []
    assert run(tmp_path, rows).summary["suspicions"] == []  # alone it looks as sound as any
    both = [*rows, *contacts("b", 11.7, 48.0)]
    assert len(run(tmp_path, both, datum=(48.2, 11.5)).summary["suspicions"]) == 2
