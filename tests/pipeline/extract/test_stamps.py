"""Stamps of all encodings become the same nanoseconds."""

from types import SimpleNamespace

import pytest

from pipeline.extract.stamps import stamp_ns

EXPECTED = 1_700_000_000_123_456_789


@pytest.mark.parametrize(
    "value",
    [
        SimpleNamespace(sec=1_700_000_000, nanosec=123_456_789),
        SimpleNamespace(secs=1_700_000_000, nsecs=123_456_789),
        SimpleNamespace(seconds=1_700_000_000, nanos=123_456_789),
        {"sec": 1_700_000_000, "nsec": 123_456_789},
        {"seconds": "1700000000", "nanos": 123_456_789},
        "2023-11-14T22:13:20.123456789Z",
        "2023-11-14 22:13:20.123456789",
        "2023-11-15T00:13:20.123456789+02:00",
        "2023-11-14 22:13:20.123456789 +0000 UTC",
        "2023-11-14 22:13:20.123456789 UTC",
        EXPECTED,
        str(EXPECTED),
    ],
)
def test_exact_forms(value: object) -> None:
    assert stamp_ns(value) == EXPECTED


def test_a_time_without_seconds() -> None:
    assert stamp_ns("2023-11-14T22:13Z") == stamp_ns("2023-11-14 22:13") == EXPECTED // (60 * 10**9) * 60 * 10**9
    assert stamp_ns("2023-11-14T22:13.5Z") is None


@pytest.mark.parametrize(("value", "factor"), [(1_700_000_000.5, 1), (1_700_000_000_500, 1e3), (1_700_000_000_500_000, 1e6)])
def test_numbers_are_told_apart_by_size(value: float, factor: float) -> None:
    assert stamp_ns(value) == 1_700_000_000_500_000_000
    assert factor * 1.7e9 == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize(
    "value",
    [None, {"sec": 0, "nsec": 0}, 0, "", "noon", "2023-13-45T00:00:00Z", float("nan"), float("inf"), {"a": 1}, {"sec": 10**12}],
)
def test_unset_or_unreadable(value: object) -> None:
    assert stamp_ns(value) is None
