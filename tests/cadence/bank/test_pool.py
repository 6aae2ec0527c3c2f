"""The pool: weights of least energy score, shrunk by doubt; hypotheses shared out; past and future from different members."""

import dataclasses
import json

import pytest
import torch
from fixtures.bank import as_tracks, random_windows, simulate

from cadence.bank.bank import Bank
from cadence.bank.components import home_ranges
from cadence.bank.hindsight import withhold
from cadence.bank.pool import SETTINGS, BankPool, best_weights, pool_as_told, pool_by_hindsight, settings_of, shared_out
from cadence.types import Detections, WindowBatch

WINDOWS = random_windows(num_windows=6)
BANK = Bank().fit(as_tracks(WINDOWS.detections), 1.0)
SAFE = torch.tensor([1.0, 0.0], dtype=torch.float64)


def normal_distances(shifts: tuple[float, float], num_rows: int, noise: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Of two members that say one place each, to truths about zero on a line."""
    truth = noise * torch.randn(num_rows, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    place = torch.tensor(shifts, dtype=torch.float64)
    return (truth - place).abs(), (place[:, None] - place).abs().expand(num_rows, 2, 2)


def test_two_places_on_either_side_of_the_truth_are_mixed() -> None:
    weight = best_weights(normal_distances((-1.0, 1.0), 400, 0.1), SAFE)
    assert weight.tolist() == pytest.approx([0.5, 0.5], abs=0.06)


def test_the_better_member_gets_all_and_doubt_holds_back() -> None:
    sure = best_weights(normal_distances((3.0, 0.0), 200, 0.5), SAFE)
    assert float(sure[1]) > 0.9
    doubtful = best_weights(normal_distances((0.4, 0.0), 4, 2.0), SAFE)
    assert float(doubtful[1]) < float(sure[1])
    assert torch.equal(best_weights(None, SAFE), SAFE)


@pytest.mark.parametrize("num_hypotheses", [3, 10, 30, 200])
def test_shares_are_kept_to_a_hypothesis_or_two(num_hypotheses: int) -> None:
    weight = torch.tensor([0.55, 0.0, 0.3, 0.15], dtype=torch.float64)
    member = shared_out(weight, num_hypotheses)
    count = torch.bincount(member, minlength=4)
    assert int(count[1]) == 0 and float((count - num_hypotheses * weight).abs().max()) <= 2.0
    assert torch.equal(shared_out(weight, 2 * num_hypotheses)[:num_hypotheses], member)


def test_a_member_alone_is_that_member() -> None:
    one = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    pool = BankPool(settings_of(BANK), one, one)
    found, want = pool.posterior(WINDOWS, 5), BANK.posterior(WINDOWS, 5)
    assert torch.equal(found.sample_m, want.sample_m)
    torch.testing.assert_close(found.mean_m, want.mean_m)
    torch.testing.assert_close(found.sigma_m, want.sigma_m, rtol=1e-5, atol=1e-5)


def test_past_and_future_come_from_their_members() -> None:
    first, second = torch.eye(5, dtype=torch.float64)[[0, 1]]
    members = settings_of(BANK)
    mixed = BankPool(members, first, second).posterior(WINDOWS, 4)
    seen = WINDOWS.detections
    last_s = torch.where(seen.is_observed, seen.time_s, -torch.inf).amax(-1)[WINDOWS.is_active]
    is_after = WINDOWS.time_s > last_s[:, None]
    for member, part in ((members[0], ~is_after), (members[1], is_after)):
        alone = member.posterior(WINDOWS, 4)
        torch.testing.assert_close(mixed.mean_m[part], alone.mean_m[part])
        rows = part[:, None].expand(-1, 4, -1)
        assert torch.equal(mixed.sample_m[rows], alone.sample_m[rows])


def test_targets_that_stay_about_a_place_are_drawn_with_a_home() -> None:
    times = torch.arange(30, dtype=torch.float64) * 6.0
    tracks = simulate(home_ranges([5.0], [1.0], [4.0]), times, 0.02, 30, 3)
    known = {name: value for name, value in vars(tracks).items() if value is not None}
    past, later = (
        Detections(**{name: value[:, :, cut] for name, value in known.items()}) for cut in (slice(20), slice(20, None))
    )
    shown = dataclasses.replace(past, time_s=past.time_s - 114.0)
    windows = WindowBatch(torch.arange(-63.0, 61.0, dtype=torch.float64), shown, torch.arange(30), 63)
    bank = Bank().fit(past, 1.0)
    pool = pool_by_hindsight(bank, withhold(windows, 0), (windows, dataclasses.replace(later, time_s=later.time_s - 114.0)))
    share = dict(zip(SETTINGS, pool.weight_future.tolist(), strict=True))
    assert bank.log_weight is not None
    assert float(bank.log_weight.exp()[bank.models.has_home].sum()) > 0.5 or share["home"] > 0.3


def test_a_bank_without_weights_is_not_pooled() -> None:
    bank = Bank(speed_mps=1.0)
    assert pool_by_hindsight(bank, withhold(WINDOWS, 0), withhold(WINDOWS, 0)).members[0].log_weight is None


def test_a_pool_is_what_it_said_of_itself_and_nothing_else() -> None:
    weight = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.0], dtype=torch.float64)
    pool = BankPool(settings_of(BANK), weight, weight.flip(0))
    again = pool_as_told(BANK, json.loads(json.dumps(pool.about())))
    assert again is not None and torch.equal(again.weight_past, weight) and torch.equal(again.weight_future, weight.flip(0))
    assert pool_as_told(BANK, {"past": {"exact": 1.0}, "future": {"exact": 1.0}}) is None
    assert pool_as_told(BANK, {}) is None
