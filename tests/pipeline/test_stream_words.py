"""What was found of a stream, in a sentence."""

from pipeline.stream_words import stream_words

SHARE = {"value": 0.2, "low": 0.15, "high": 0.25}
COUNTS = {
    "num_agents": 4, "num_agents_probability": 0.93, "num_agents_low": 4, "num_agents_high": 5, "clutter": SHARE,
    "detection": SHARE, "mean_gap_s": 50.0,
}  # fmt: skip


def test_what_was_found() -> None:
    assert stream_words({"counts": COUNTS, "stated": []}) == (
        "detections without identity: 4 agents (probability 0.93, 95 %: 4 to 5), 20.0% (15.0% to 25.0%) of the detections are "
        "clutter, an agent is detected in 20.0% (15.0% to 25.0%) of the scans, an agent is seen once in 50 s"
    )


def test_what_cannot_be_told_is_said() -> None:
    unsure = COUNTS | {"num_agents_probability": 0.4, "detection": None, "mean_gap_s": None}
    assert "how many agents there are cannot be told (4 to 5; 4 is the likeliest)" in stream_words({"counts": unsure})
    assert "the number is stated" in stream_words({"counts": COUNTS, "stated": ["num_agents"]})
    assert stream_words({}) == ""
