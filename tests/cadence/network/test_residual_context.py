"""The network's view of a window: no metres, no seconds, no place, no special direction."""

import dataclasses

import torch
from fixtures.bank import Moved, as_tracks, random_windows, turn_matrix

from cadence.bank.bank import Bank, BankPosterior
from cadence.bank.rows import active_rows
from cadence.bank.smoother import Nodes
from cadence.network.residual_context import (
    MAX_DETECTIONS,
    NUM_DETECTION_FEATURES,
    NUM_FEATURES,
    ResidualContext,
    build_context,
    encoder_rows,
    features,
    rotate,
)
from cadence.types import WindowBatch

WINDOWS = random_windows()
BANK = Bank().fit(as_tracks(WINDOWS.detections), 1.0)
EYE = torch.eye(2, dtype=torch.float64)


def seen_by(bank: Bank, windows: WindowBatch) -> ResidualContext:
    rows, _ = active_rows(windows)
    return build_context(bank.posterior(windows, 1), rows, windows.time_s, windows.step_s, bank.length_m(windows.step_s))


def assert_same(one: ResidualContext, two: ResidualContext, tolerance: float) -> None:
    for field in dataclasses.fields(ResidualContext):
        a, b = getattr(one, field.name), getattr(two, field.name)
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


def test_place_and_units_are_not_seen() -> None:
    plain = seen_by(BANK, WINDOWS)
    far = Moved(EYE, torch.tensor([300.0, -200.0], dtype=torch.float64), scale=50.0, time_scale=4.0)
    bank = dataclasses.replace(BANK, speed_mps=(BANK.speed_mps or 0.0) * 50.0 / 4.0)
    assert_same(seen_by(bank, far.windows(WINDOWS)), plain, 2e-3)


def test_turning_the_context_is_turning_the_world() -> None:
    windows = dataclasses.replace(
        WINDOWS, detections=dataclasses.replace(WINDOWS.detections, covariance_m2=(0.04 * EYE).expand(4, 2, 7, 2, 2))
    )
    world = Moved(turn_matrix(0.9), torch.zeros(2, dtype=torch.float64))
    context = seen_by(BANK, windows)
    angle = torch.full((len(context.mean),), 0.9)
    assert_same(context.rotated(angle), seen_by(BANK, world.windows(windows)), 1e-4)


def test_rotation() -> None:
    vectors = torch.tensor([[[1.0, 0.0]], [[0.0, 2.0]]])
    got = rotate(vectors, torch.tensor([torch.pi / 2, torch.pi]))
    torch.testing.assert_close(got, torch.tensor([[[0.0, 1.0]], [[0.0, -2.0]]]), rtol=0, atol=1e-6)


def one_row(times: list[float], num_padding: int = 0) -> ResidualContext:
    """A context whose bank says (1, 2) with sigma 3 at all of the steps -4 ... 3 of 2 s; the unit of length is 10 m."""
    grid = 2.0 * torch.arange(-4.0, 4.0, dtype=torch.float64)
    num = len(times) + num_padding
    time_s = torch.tensor([[*times, *[times[-1]] * num_padding]], dtype=torch.float64)
    position = torch.stack([torch.arange(num), -torch.arange(num)], -1)[None].double() * 10.0
    covariance = (25.0 * EYE).expand(1, num, 2, 2)
    rows = Nodes(time_s, position, covariance, torch.arange(num)[None] < len(times))
    mean = torch.tensor([1.0, 2.0], dtype=torch.float64).expand(1, 8, 2)
    sigma = torch.full((1, 8), 3.0, dtype=torch.float64)
    return build_context(BankPosterior(mean, sigma, mean[:, None]), rows, grid, 2.0, 10.0)


def test_by_hand() -> None:
    context = one_row([-7.0, -2.0])
    far = 7.0
    assert context.since[0].tolist() == [far, 0.5, 1.5, 0.0, 1.0, 2.0, 3.0, 4.0]
    assert context.until[0].tolist() == [0.5, 2.0, 1.0, 0.0, far, far, far, far]
    assert context.is_future[0].tolist() == [False] * 5 + [True] * 3
    # about the last detection, which lies at (10, -10) m
    torch.testing.assert_close(context.mean[0, 0], torch.tensor([-0.9, 1.2]))
    torch.testing.assert_close(context.sigma[0], torch.full((8,), 0.3))
    sigma = float(torch.tensor(0.5).log())
    torch.testing.assert_close(context.detections[0], torch.tensor([[3.5, -1.0, 1.0, sigma], [1.0, 0.0, 0.0, sigma]]))
    assert_same(one_row([-7.0, -2.0], 3)[slice(0, 1)], dataclasses.replace(context, **padded(context, 3)), 0.0)


def padded(context: ResidualContext, num: int) -> dict[str, torch.Tensor]:
    pad = torch.nn.functional.pad
    return {"detections": pad(context.detections, (0, 0, 0, num)), "is_observed": pad(context.is_observed, (0, num))}


def test_the_last_detections_are_read() -> None:
    times = [-6.0 + 0.1 * i for i in range(MAX_DETECTIONS + 10)]
    context = one_row(times, num_padding=4)
    assert tuple(context.detections.shape) == (1, MAX_DETECTIONS, NUM_DETECTION_FEATURES)
    assert bool(context.is_observed.all())
    torch.testing.assert_close(context.detections[0, :, 0], -torch.tensor(times[10:]) / 2.0)


def test_features() -> None:
    context = seen_by(BANK, WINDOWS).repeated(3)
    noisy = torch.randn(*context.mean.shape, generator=torch.Generator().manual_seed(0))
    got = features(noisy, context)
    assert tuple(got.shape) == (len(noisy), NUM_FEATURES, WINDOWS.num_steps)
    torch.testing.assert_close(got[:, :2].mT, noisy)
    assert float(got.abs().max()) < 20.0
    # no noise: the path is the bank's mean
    still = features(torch.zeros_like(noisy), context)
    torch.testing.assert_close(still[:, 2:4], still[:, 4:6])
    torch.testing.assert_close(still[:, 6:8], still[:, 8:10])
    rows = encoder_rows(context)
    assert tuple(rows.shape[2:]) == (NUM_DETECTION_FEATURES,)
    assert not rows[~context.is_observed].any()


def test_repeated_keeps_a_windows_hypotheses_together() -> None:
    context = seen_by(BANK, WINDOWS)
    wide = context.repeated(3)
    for field in dataclasses.fields(ResidualContext):
        a, b = getattr(context, field.name), getattr(wide, field.name)
        assert torch.equal(b.unflatten(0, (-1, 3))[:, 2], a)
