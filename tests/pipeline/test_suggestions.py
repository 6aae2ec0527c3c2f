"""What may have been meant by a word that is not known."""

from pipeline.suggestions import by_likeness, did_you_mean


def test_the_likeliest_word_is_named_and_none_where_none_is_like():
    known = ["num_hypotheses", "num_steps", "Checkpoint"]
    assert did_you_mean("num_hypothesis", known) == " (did you mean 'num_hypotheses'?)"
    assert did_you_mean("checkpoint", known) == " (did you mean 'Checkpoint'?)"
    assert did_you_mean("zzz", known) == "" and did_you_mean("x", []) == ""


def test_likely_words_come_first_and_equals_keep_their_order():
    assert by_likeness("/radar/plot", ["zz", "yy", "/radar/plots"]) == ["/radar/plots", "zz", "yy"]
    assert by_likeness("zzz", ["b", "a"]) == ["b", "a"]
