"""The classical rivals: one model of greatest likelihood, smoothed, sampled, and nothing else."""

import dataclasses

import pytest
import torch
from fixtures.bank import as_tracks, random_windows, simulate

from cadence.bank.components import constant_velocity, ornstein_uhlenbeck
from cadence.bank.fitting import FLOOR_STEPS, log_likelihood
from cadence.bank.hindsight import hindsight_scores, withhold
from cadence.bank.rows import track_rows
from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from cadence.types import Detections, Estimator, WindowBatch

RIVALS = [ConstantVelocityKalman(), OrnsteinUhlenbeckKalman()]
TIMES = torch.arange(12, dtype=torch.float64) * 2.0
WINDOWS = random_windows()


def test_noise_of_constant_velocity_is_found() -> None:
    tracks = simulate(constant_velocity([0.04], initial_speed=1.0), TIMES, 0.05, 80, 0)
    bank = ConstantVelocityKalman().fit(tracks, 1.0).bank
    scaled = bank.models.scaled(1.0, bank.speed_mps or 0.0)
    assert float(scaled.diffusion) == pytest.approx(0.04, rel=0.3)


def test_memory_and_speed_of_ornstein_uhlenbeck_are_found() -> None:
    true = ornstein_uhlenbeck([5.0], [1.2], [0.0])
    tracks = simulate(true, TIMES, 0.05, 80, 0)
    bank = OrnsteinUhlenbeckKalman().fit(tracks, 1.0).bank
    speed_mps = bank.speed_mps or 0.0
    scaled = bank.models.scaled(1.0, speed_mps)
    assert float(1.0 / scaled.relaxation_rate) == pytest.approx(5.0, rel=0.4)
    assert float(scaled.initial_speed) == pytest.approx(1.2, rel=0.2)
    best, of_truth = (
        float(log_likelihood(models, track_rows(tracks), 1.0, unit).sum())
        for models, unit in ((bank.models, speed_mps), (true.scaled(1.0, 1.0 / speed_mps), speed_mps))
    )
    assert best > of_truth


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_no_neighbour_is_likelier_than_the_fitted_model(rival: ConstantVelocityKalman) -> None:
    tracks = simulate(ornstein_uhlenbeck([5.0], [1.2], [0.0]), TIMES, 0.05, 40, 1)
    bank, rows = rival.fit(tracks, 1.0).bank, track_rows(tracks)
    assert len(bank.models) == 1 and bank.switch_rate == 0.0 and bank.temper == 1.0 and bank.speed_mps is not None
    best = float(log_likelihood(bank.models, rows, 1.0, bank.speed_mps).sum())
    for factor in (0.4, 2.5):
        changed = dataclasses.replace(bank.models, diffusion=factor * bank.models.diffusion)
        assert float(log_likelihood(changed, rows, 1.0, bank.speed_mps).sum()) < best


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_the_call_is_that_of_every_estimator(rival: Estimator) -> None:
    with pytest.raises(ValueError, match="fit"):
        rival.sample(WINDOWS, 2)
    fitted = rival.fit(as_tracks(WINDOWS.detections))
    found, again = fitted.sample(WINDOWS, 5), fitted.sample(WINDOWS, 5)
    assert tuple(found.position_m.shape) == (4, 5, 2, WINDOWS.num_steps, 2)
    assert torch.isfinite(found.position_m).all()
    assert torch.equal(found.position_m, again.position_m)
    assert fitted.name == rival.name


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_nothing_to_learn_from(rival: Estimator) -> None:
    nothing = Detections(torch.zeros(0, 1, 1), torch.zeros(0, 1, 1, 2), torch.zeros(0, 1, 1, 2, 2), torch.zeros(0, 1, 1) > 0)
    lone = as_tracks(WINDOWS.detections)
    lone = dataclasses.replace(lone, is_observed=torch.arange(7).expand(8, 1, 7) < 1)
    for tracks in (nothing, lone):
        assert torch.isfinite(rival.fit(tracks).sample(WINDOWS, 2).position_m).all()


def steady_and_few_wild(num_steady: int = 30, num_wild: int = 3) -> tuple[WindowBatch, Detections]:
    """Windows of targets that go straight, with a few that do not, and their detections after the origin."""
    times = torch.arange(20, dtype=torch.float64) * 2.0
    parts = [
        simulate(constant_velocity([noise], initial_speed=1.0), times, 0.02, number, 5)
        for noise, number in ((1e-5, num_steady), (3.0, num_wild))
    ]
    fields = [name for name, value in vars(parts[0]).items() if value is not None]
    both = Detections(**{name: torch.cat([getattr(part, name) for part in parts]) for name in fields})
    both = dataclasses.replace(both, time_s=both.time_s - 26.0)
    cuts = (slice(14), slice(14, None))
    past, later = (Detections(**{name: getattr(both, name)[:, :, cut] for name in fields}) for cut in cuts)
    return WindowBatch(torch.arange(-27.0, 13.0, dtype=torch.float64), past, torch.arange(num_steady + num_wild), 27), later


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_hindsight_finds_what_likelihood_misses(rival: ConstantVelocityKalman) -> None:
    windows, later = steady_and_few_wild()
    fitted = rival.fit(windows.detections, 1.0)
    tuned = fitted.tuned([(windows, later), withhold(windows, 0)])
    # a few wild targets make the noise of greatest likelihood far too great for all others
    assert float(tuned.bank.models.diffusion) < 0.1 * float(fitted.bank.models.diffusion)
    by_likelihood, by_hindsight = (float(hindsight_scores(one, windows, later).mean()) for one in (fitted, tuned))
    assert by_hindsight < 0.8 * by_likelihood


@pytest.mark.parametrize("rival", RIVALS, ids=lambda rival: rival.name)
def test_too_few_detections_to_compare_change_nothing(rival: ConstantVelocityKalman) -> None:
    fitted = rival.fit(as_tracks(WINDOWS.detections), 1.0)
    nothing = dataclasses.replace(WINDOWS.detections, is_observed=torch.zeros_like(WINDOWS.detections.is_observed))
    few = dataclasses.replace(WINDOWS, detections=dataclasses.replace(
        WINDOWS.detections, is_observed=torch.arange(7).expand(4, 2, 7) < 2))  # fmt: skip
    assert fitted.tuned([(few, nothing), withhold(few, 0)]) is fitted


def test_noise_of_detections_adds_to_their_own() -> None:
    fitted = ConstantVelocityKalman().fit(as_tracks(WINDOWS.detections), 1.0)
    length_m, floor = fitted.bank.length_m(WINDOWS.step_s), FLOOR_STEPS
    noisier = dataclasses.replace(fitted, noise_steps=0.5)
    d = WINDOWS.detections
    added = (0.5**2 - floor**2) * length_m**2 * torch.eye(2, dtype=torch.float64)
    stated = dataclasses.replace(WINDOWS, detections=dataclasses.replace(d, covariance_m2=d.covariance_m2 + added))
    torch.testing.assert_close(noisier.sample(WINDOWS, 3).position_m, fitted.sample(stated, 3).position_m)
    assert torch.equal(dataclasses.replace(fitted, noise_steps=0.0).sample(WINDOWS, 3).position_m,
                       fitted.sample(WINDOWS, 3).position_m)  # fmt: skip


def test_units_of_time_do_not_matter() -> None:
    tracks = as_tracks(WINDOWS.detections)
    one = OrnsteinUhlenbeckKalman().fit(tracks, 1.0).bank
    slow = dataclasses.replace(tracks, time_s=10.0 * tracks.time_s)
    ten = OrnsteinUhlenbeckKalman().fit(slow, 10.0).bank
    torch.testing.assert_close(ten.models.relaxation_rate, one.models.relaxation_rate)
    torch.testing.assert_close(ten.models.diffusion, one.models.diffusion)
