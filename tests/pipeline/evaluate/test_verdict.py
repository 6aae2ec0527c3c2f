"""The verdict in words that comes before all tables."""

import pytest

from pipeline.evaluate.tables import OWN_NAME, RatioRow, ScoreReport, as_markdown, verdict
from pipeline.score_words import coverage_words
from pipeline.scoring.scores import ScoreRow


def report(coverage: float, *ratios: tuple[str, float, float, float]) -> ScoreReport:
    """A report on the future alone: coverage, and the ratio to each rival with its interval."""
    row = ScoreRow(OWN_NAME, "future", "part", None, None, "coverage_90", coverage, coverage, coverage, 9, 3)
    other = ScoreRow("hold", "future", "part", None, None, "coverage_90", 0.123, 0.1, 0.2, 9, 3)
    rows = tuple(RatioRow(OWN_NAME, rival, "future", *values, 9, 3) for rival, *values in ratios)
    return ScoreReport(1, "block", (), (other, row), rows)


def test_the_best_rival_is_the_one_that_counts() -> None:
    (sentence,) = verdict(report(0.9, ("cv", 0.5, 0.4, 0.6), ("bank", 0.88, 0.8, 0.95)))
    says = "the energy score is 12 % below that of the best rival (bank of smoothers); the 90 % region holds 90 % of the truth"
    assert sentence == f"Future: {says}: as it should."
    (sentence,) = verdict(report(0.9, ("cv", 0.5, 0.4, 0.6), ("hold", 1.34, 1.1, 1.5)))
    assert "is 34 % above that of the best rival (stays where seen); the" in sentence
    (sentence,) = verdict(report(0.9, ("cv", 0.997, 0.8, 1.1)))
    assert "score is within half a per cent of that of the best rival (constant velocity), which may be chance" in sentence
    (sentence,) = verdict(report(0.9, ("cv", 0.95, 0.8, 1.1)))
    assert "5 % below that of the best rival (constant velocity), which may be chance; the" in sentence


@pytest.mark.parametrize(
    ("coverage", "judged"),
    [(0.0, "do not believe it"), (0.7, "it is too narrow"), (0.88, "as it should"), (0.99, "it is too wide")],
)
def test_a_region_that_does_not_hold_its_share_is_called_so(coverage: float, judged: str) -> None:
    (sentence,) = verdict(report(coverage))
    assert sentence == f"Future: the 90 % region holds {100 * coverage:.0f} % of the truth: {judged}."


def test_that_a_region_is_wrong_is_not_said_of_what_may_be_chance() -> None:
    assert coverage_words(0.97, 0.88, 1.0) == "it is too wide, which may be chance"
    assert coverage_words(0.97, 0.95, 1.0) == "it is too wide" and coverage_words(0.89, 0.8, 0.95) == "as it should"


def test_it_comes_first_and_says_nothing_where_nothing_was_scored() -> None:
    assert as_markdown(report(0.9)).splitlines()[2] == "* Future: the 90 % region holds 90 % of the truth: as it should."
    assert verdict(report(float("nan"))) == []
