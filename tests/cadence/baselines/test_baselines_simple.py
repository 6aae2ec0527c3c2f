"""Linear interpolation and hold: exact at detections, calibrated on random walks, deterministic window by window."""

import math

import pytest
import torch

from cadence import metrics
from cadence.baselines.interpolation import GapLaw, Hold, LinearInterpolation
from cadence.types import Detections, WindowBatch

ESTIMATORS = [Hold(law=GapLaw(2.0, 0.5)), LinearInterpolation(law=GapLaw(1.0, 0.5), hold_law=GapLaw(2.0, 0.5))]


def detections(time_s: list[list[float]], position_m: torch.Tensor, variance_m2: float = 1e-8) -> Detections:
    time = torch.tensor(time_s, dtype=torch.float64)[:, None]
    covariance = variance_m2 * torch.eye(2, dtype=torch.float64).expand(*time.shape, 2, 2)
    return Detections(time, position_m.double()[:, None], covariance.clone(), torch.ones_like(time, dtype=torch.bool))


def windows_of(found: Detections, step_s: float = 1.0) -> WindowBatch:
    time_s = torch.arange(-8, 9, dtype=torch.float64) * step_s
    return WindowBatch(time_s, found, torch.arange(found.time_s.shape[0]) + 5, 8)


def two_point_window(variance_m2: float = 1e-8) -> WindowBatch:
    return windows_of(detections([[-6.0, -2.0]], torch.tensor([[[0.0, 0.0], [8.0, -4.0]]]), variance_m2))


def test_unfitted_estimators_draw_the_plain_line_and_hold() -> None:
    window = two_point_window()
    line = LinearInterpolation().sample(window, 3).position_m[0, :, 0]
    held = Hold().sample(window, 3).position_m[0, :, 0]
    torch.testing.assert_close(line[:, 4], torch.tensor([[4.0, -2.0]] * 3).double(), atol=1e-2, rtol=0)
    expected = {0: (0.0, 0.0), 2: (0.0, 0.0), 4: (0.0, 0.0), 6: (8.0, -4.0), 16: (8.0, -4.0)}
    for step, position in expected.items():
        torch.testing.assert_close(held[:, step], torch.tensor([position] * 3).double(), atol=1e-2, rtol=0)
    torch.testing.assert_close(line[:, 16], held[:, 16], atol=1e-2, rtol=0)


def test_spread_follows_the_laws() -> None:
    window, k = two_point_window(), 4000
    line = LinearInterpolation(law=GapLaw(1.0, 0.7), hold_law=GapLaw(0.5, 0.9)).sample(window, k).position_m[0, :, 0]
    sigma = line.std(dim=0).mean(dim=-1)
    assert sigma[4].item() == pytest.approx(4.0**0.7, rel=0.05)  # middle of the gap of 4 s
    assert sigma[3].item() == pytest.approx(4.0**0.7 * math.sqrt(0.75), rel=0.05)
    assert sigma[[2, 6]].max().item() < 1e-3  # at the detections
    assert sigma[16].item() == pytest.approx(0.5 * 10.0**0.9, rel=0.05)
    assert sigma[0].item() == pytest.approx(0.5 * 2.0**0.9, rel=0.05)
    correlation = torch.corrcoef(line[:, [3, 5], 0].T)[0, 1].item()
    assert correlation == pytest.approx(1 / 3, abs=0.06)  # Brownian bridge at 1/4 and 3/4: (1/16) / (3/16)


def test_detection_noise_is_drawn() -> None:
    sample = LinearInterpolation().sample(two_point_window(variance_m2=9.0), 4000).position_m[0, :, 0]
    assert sample[:, 6].std(dim=0).mean().item() == pytest.approx(3.0, rel=0.05)
    assert sample[:, 4].std(dim=0).mean().item() == pytest.approx(3.0 / math.sqrt(2), rel=0.05)


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: e.name)
def test_a_window_does_not_depend_on_its_neighbours(estimator: Hold | LinearInterpolation) -> None:
    generator = torch.Generator().manual_seed(0)
    position = torch.randn(3, 5, 2, generator=generator)
    found = detections([[-7.5, -6.0, -3.3, -1.0, -0.5]] * 3, position)
    found.is_observed[1, 0, 2:] = False
    found.is_observed[2] = False
    windows = windows_of(found)
    together = estimator.sample(windows, 4)
    assert together.status == (("ok",), ("ok",), ("no_detections",))
    assert together.position_m[2].isnan().all() and not together.position_m[:2].isnan().any()
    for b in range(2):
        alone = estimator.sample(windows[torch.tensor([b])], 4)
        assert torch.equal(alone.position_m[0], together.position_m[b])
    unpadded = Detections(*(x[1:2, :, :2] for x in (found.time_s, found.position_m, found.covariance_m2, found.is_observed)))
    short = estimator.sample(WindowBatch(windows.time_s, unpadded, windows.seeds[1:2], 8), 4)
    assert torch.equal(short.position_m[0], together.position_m[1])


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: e.name)
def test_translation_moves_the_samples(estimator: Hold | LinearInterpolation) -> None:
    window = two_point_window()
    moved = two_point_window()
    moved.detections.position_m[...] += torch.tensor([1000.0, -500.0])
    shift = estimator.sample(moved, 5).position_m - estimator.sample(window, 5).position_m
    torch.testing.assert_close(shift, torch.tensor([1000.0, -500.0]).double().expand_as(shift))


def random_walks(generator: torch.Generator, b: int, n: int, is_smooth: bool) -> torch.Tensor:
    steps = torch.randn(b, n, 2, generator=generator, dtype=torch.float64)
    return 3.0 * (steps.cumsum(dim=1).cumsum(dim=1) if is_smooth else steps.cumsum(dim=1))


@pytest.mark.parametrize(("is_smooth", "low", "high"), [(False, 0.4, 0.6), (True, 0.7, 1.6)])
def test_fit_finds_the_exponent_and_is_calibrated(is_smooth: bool, low: float, high: float) -> None:
    generator = torch.Generator().manual_seed(1)
    walk = random_walks(generator, 60, 400, is_smooth)
    chosen = torch.arange(0, 400, 4)
    times = chosen.double().tolist()
    tracks = detections([times] * 60, walk[:, chosen])
    held, line = Hold().fit(tracks), LinearInterpolation().fit(tracks)
    assert low < held.law.exponent < high and low < line.law.exponent < high + 0.5
    if not is_smooth:
        assert held.law.scale_m == pytest.approx(3.0, rel=0.25)
    truth = walk[:, 200 - 8 : 200 + 9] - walk[:, 200:201]
    seen = [0, 8]  # steps -8 and 0: a gap of 8 s, then nothing
    windows = windows_of(detections([[-8.0, 0.0]] * 60, truth[:, seen]))
    for estimator, step in ((line, 4), (held, 12), (line, 12)):
        found = estimator.sample(windows, 50)
        inside = metrics.coverage(found.position_m, found.weight, truth[:, None])[1, :, 0, step].mean().item()
        assert 0.78 <= inside <= 1.0


def test_fit_without_enough_detections_keeps_the_law() -> None:
    lonely = detections([[0.0]], torch.zeros(1, 1, 2))
    for estimator in ESTIMATORS:
        assert estimator.fit(lonely) == estimator
    still = detections([[0.0, 1.0, 2.0, 3.0]], torch.zeros(1, 4, 2))
    assert Hold().fit(still).law.scale_m < 1e-2


def test_fit_sees_that_an_agent_stays_in_its_place() -> None:
    generator = torch.Generator().manual_seed(4)
    phase = 6.28 * torch.rand(40, 1, generator=generator, dtype=torch.float64)
    angle = phase + 0.7 * torch.arange(100, dtype=torch.float64)
    circle = 10.0 * torch.stack([angle.cos(), angle.sin()], dim=-1)
    law = Hold().fit(detections([list(map(float, range(100)))] * 40, circle)).law
    sigma = law.variance(torch.tensor([5.0, 50.0], dtype=torch.float64)).sqrt()
    assert sigma[1].item() == pytest.approx(10.0, rel=0.15)  # the root of half of twice the mean square of the radius
    assert sigma[0].item() == pytest.approx(10.0, rel=0.4)
