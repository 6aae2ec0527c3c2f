"""The paper's model as an estimator: inpainting, guidance, seeds, frames, and that it learns what it is shown."""

import dataclasses
import math

import pytest
import torch

from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.absolute import (
    AbsoluteConfig,
    AbsoluteModel,
    AbsoluteSampling,
    detection_rows,
)
from cadence.errors import ConfigError
from cadence.network.trajectory import TrajectoryNetwork, TrajectoryNetworkConfig
from cadence.training.absolute import AbsoluteWindows, absolute_loss, join_absolute
from cadence.types import Context, Detections, WindowBatch

NETWORK = TrajectoryNetworkConfig(
    num_steps=16, num_levels=12, width=16, multipliers=(1, 2), num_blocks=1, encoder_size=16, level_size=16
)
CONFIG = AbsoluteConfig(NETWORK, step_s=2.0, centre_m=(100.0, 50.0), scale_m=200.0, age_scale_steps=32.0)
FAST = AbsoluteSampling("ddim", 4)
PAPER_SAMPLING = AbsoluteSampling(inpainting="overwrite", guidance="paper")


def batch(b=3, a=2, n=4, seed=0, origin=0, num_steps=16):
    generator = torch.Generator().manual_seed(seed)
    time = -2.0 * torch.arange(n - 1, -1, -1).double().expand(b, a, n)
    position = 40.0 * torch.randn(b, a, n, 2, generator=generator, dtype=torch.float64)
    observed = torch.ones(b, a, n, dtype=torch.bool)
    observed[0, 0, 2:] = False
    observed[1, 1] = False
    covariance = torch.zeros(b, a, n, 2, 2, dtype=torch.float64)
    grid = 2.0 * (torch.arange(num_steps).double() - origin)
    context = Context(torch.tensor([[120.0, 40.0]]).double().expand(b, 2))
    return WindowBatch(grid, Detections(time, position, covariance, observed), torch.arange(7, 7 + b), origin, context)


def among(obstacles, windows):
    """The same windows with obstacles in the mission frame."""
    return windows.with_context(dataclasses.replace(windows.context, obstacles=obstacles))


def model(sampling=FAST, config=CONFIG, **changes):
    network = TrajectoryNetwork(config.network)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
    return AbsoluteModel(network.eval(), config, sampling, **changes)


def test_shapes_status_and_inactive_agents():
    found = model().sample(batch(), 5)
    assert found.position_m.shape == (3, 5, 2, 16, 2)
    assert found.status[1] == ("ok", "no_detections")
    assert found.position_m[1, :, 1].isnan().all()
    assert found.position_m[0].isfinite().all()
    torch.testing.assert_close(found.weight.sum(-1), torch.ones(3).double())


@pytest.mark.parametrize("sampling", [FAST, AbsoluteSampling("dpmpp", 4), AbsoluteSampling("ddpm"), PAPER_SAMPLING])
def test_same_seed_same_bytes_and_windows_do_not_matter_to_each_other(sampling):
    windows, estimator = batch(), model(sampling)
    first = estimator.sample(windows, 4).position_m
    assert torch.equal(first.nan_to_num(), estimator.sample(windows, 4).position_m.nan_to_num())
    alone = model(sampling).sample(windows[2:], 4).position_m
    torch.testing.assert_close(alone[0], first[2], rtol=0, atol=2e-3)
    in_chunks = model(dataclasses.replace(sampling, chunk=4)).sample(windows, 4).position_m
    torch.testing.assert_close(in_chunks, first, equal_nan=True, rtol=0, atol=2e-3)
    other = dataclasses.replace(windows, seeds=windows.seeds + 100)
    assert not torch.allclose(estimator.sample(other, 4).position_m[0], first[0], atol=1.0)


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpmpp"])
@pytest.mark.parametrize("inpainting", ["overwrite", "noise_matched", "smoother"])
def test_detections_on_the_grid_are_met(sampler, inpainting):
    """Past and future in one window: exact detections are where they were seen, whatever the network says."""
    config = dataclasses.replace(CONFIG, history_steps=9)
    windows = batch(origin=8)
    estimator = model(AbsoluteSampling(sampler, 4, inpainting, floor=0.0), config)
    found = estimator.sample(windows, 3).position_m
    seen = windows.detections
    for k in range(3):
        torch.testing.assert_close(found[2, k, 1, 5:9], seen.position_m[2, 1], rtol=0, atol=0.05)
        torch.testing.assert_close(found[0, k, 0, 5:7], seen.position_m[0, 0, :2], rtol=0, atol=0.05)


def test_nothing_on_the_grid_changes_nothing():
    """With one step of history and the last detection before it, inpainting has nothing to do."""
    windows = batch()
    seen = dataclasses.replace(windows.detections, time_s=windows.detections.time_s - 3.0)
    windows = dataclasses.replace(windows, detections=seen)
    free = model(dataclasses.replace(FAST, inpainting="none")).sample(windows, 3).position_m.nan_to_num()
    for inpainting in ("overwrite", "noise_matched", "smoother"):
        found = model(dataclasses.replace(FAST, inpainting=inpainting)).sample(windows, 3).position_m.nan_to_num()
        assert torch.equal(found, free)


def test_covariance_spreads_hypotheses():
    windows = batch()
    seen = windows.detections
    noisy = dataclasses.replace(seen, covariance_m2=seen.covariance_m2 + 25.0 * torch.eye(2).double())
    spread = model().sample(dataclasses.replace(windows, detections=noisy), 400).position_m[2, :, 0, 0].std(dim=0)
    torch.testing.assert_close(spread, torch.full((2,), 5.0).double(), rtol=0.1, atol=0)
    assert model().sample(windows, 400).position_m[2, :, 0, 0].std(dim=0).max() < 0.1


def test_guidance_without_anything_to_obey_is_no_guidance():
    windows = batch()
    free = model().sample(windows, 3).position_m.nan_to_num()
    assert torch.equal(model(dataclasses.replace(FAST, guidance="clean")).sample(windows, 3).position_m.nan_to_num(), free)
    far = Obstacles(torch.tensor([[1e6, 1e6, 5.0]], dtype=torch.float64))
    guided = model(dataclasses.replace(FAST, guidance="clean", max_speed_mps=1e6))
    torch.testing.assert_close(guided.sample(among(far, windows), 3).position_m.nan_to_num(), free, rtol=0, atol=1e-3)
    ddpm = AbsoluteSampling("ddpm", inpainting="overwrite")
    still = dataclasses.replace(ddpm, guidance="paper", iterations=0)
    assert torch.equal(
        model(still).sample(windows, 3).position_m.nan_to_num(), model(ddpm).sample(windows, 3).position_m.nan_to_num()
    )


def test_clean_guidance_leaves_obstacles_and_keeps_detections():
    config = dataclasses.replace(CONFIG, network=dataclasses.replace(NETWORK, prediction="x0"))
    windows = batch()[torch.tensor([2])]
    free = model(FAST, config).sample(windows, 20).position_m
    hill = Obstacles(torch.tensor([[80.0, 60.0, 60.0]], dtype=torch.float64))
    sampling = dataclasses.replace(FAST, guidance="clean")
    guided = model(sampling, config).sample(among(hill, windows), 20).position_m

    def inside(track):
        offset = torch.tensor([120.0, 40.0]).double()
        return (hill.signed_distance(track[:, :, :, 1:], offset_m=offset)[0] < -0.5).double().mean()

    assert inside(free) > 0.05
    assert inside(guided) < 0.3 * inside(free)
    torch.testing.assert_close(guided[..., 0, :], free[..., 0, :], rtol=0, atol=0.1)


def test_paper_guidance_shortens_steps():
    windows = batch()
    plain = model(dataclasses.replace(PAPER_SAMPLING, guidance="none")).sample(windows, 5).position_m
    guided = model(PAPER_SAMPLING).sample(windows, 5).position_m

    def length(track):
        return (track[..., 1:, :] - track[..., :-1, :]).norm(dim=-1).nanmean()

    assert length(guided) < 0.9 * length(plain)


def test_reading_the_detections_at_each_step_is_only_slower():
    windows = batch()
    once = model().sample(windows, 3).position_m
    each = model(dataclasses.replace(FAST, encode_each_step=True)).sample(windows, 3).position_m
    torch.testing.assert_close(each, once, equal_nan=True, rtol=0, atol=1e-3)


def test_absolute_networks_know_the_map_and_relative_ones_do_not():
    """The datum of the windows is a detail of the windows; the mission frame is not, unless the model is relative."""
    windows = batch()
    shift = torch.tensor([300.0, -50.0]).double()
    seen = dataclasses.replace(windows.detections, position_m=windows.detections.position_m - shift)
    elsewhere = dataclasses.replace(windows, detections=seen)
    datum = Context(torch.tensor([[120.0, 40.0]]).double().expand(3, 2) + shift)
    found = model().sample(windows, 3).position_m
    torch.testing.assert_close(
        model().sample(elsewhere.with_context(datum), 3).position_m + shift, found, equal_nan=True, rtol=0, atol=2e-3
    )
    assert not torch.allclose(model().sample(elsewhere, 3).position_m[0] + shift, found[0], atol=1.0)
    relative = model(config=dataclasses.replace(CONFIG, relative=True))
    torch.testing.assert_close(
        relative.sample(elsewhere.with_context(None), 3).position_m + shift, relative.sample(windows, 3).position_m,
        equal_nan=True, rtol=0, atol=2e-3,
    )  # fmt: skip


def test_goal_and_elapsed_reach_the_network():
    config = dataclasses.replace(CONFIG, network=dataclasses.replace(NETWORK, known_goal=True, elapsed=True))
    windows, estimator = batch(), model(config=config)
    with pytest.raises(ConfigError, match="goal"):
        estimator.sample(windows, 2)
    context = dataclasses.replace(windows.context, known_goal_m=torch.zeros(3, 2, 2).double(), elapsed_s=torch.zeros(3))
    near = estimator.sample(windows.with_context(context), 2).position_m
    later = dataclasses.replace(context, elapsed_s=torch.full((3,), 1e4))
    there = dataclasses.replace(context, known_goal_m=torch.full((3, 2, 2), 90.0).double())
    for other in (later, there):
        assert not torch.allclose(estimator.sample(windows.with_context(other), 2).position_m[0], near[0], atol=0.01)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match="history_steps = 1, horizon_steps = 15"):
        model().sample(batch(origin=4), 2)
    with pytest.raises(ConfigError, match="step_s = 2"):
        model().sample(dataclasses.replace(batch(), time_s=batch().time_s * 2), 2)
    with pytest.raises(ValueError, match="where they are"):
        model().sample(batch().with_context(None), 2)
    with pytest.raises(ValueError, match="context of 1"):
        batch().with_context(Context(torch.zeros(1, 2).double()))
    with pytest.raises(ValueError, match="ddpm"):
        AbsoluteSampling("ddim", guidance="paper")
    with pytest.raises(ValueError, match="history_steps"):
        AbsoluteConfig(NETWORK, history_steps=17)


def test_detection_rows_are_the_last_ones_left_packed():
    age = torch.tensor([[5.0, 4.0, 3.0, 2.0], [9.0, 8.0, 0.0, 0.0], [0.0] * 4])
    observed = torch.tensor([[True] * 4, [True, True, False, False], [False] * 4])
    rows, is_kept = detection_rows(age, age[..., None].expand(-1, -1, 2), observed, 3)
    assert rows[..., 0].tolist() == [[4.0, 3.0, 2.0], [9.0, 8.0, 0.0], [0.0, 0.0, 0.0]]
    assert is_kept.tolist() == [[True] * 3, [True, True, False], [False] * 3]
    wide, mask = detection_rows(age, age[..., None].expand(-1, -1, 2), observed, 6)
    assert wide.shape == (3, 6, 3) and mask.sum(1).tolist() == [4, 2, 0]


def lesson(num=8, seed=0):
    """Straight tracks, each told apart by its one detection at the first step: training windows and the batch to sample."""
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand(num, 2, generator=generator) - 0.5
    turn = 2 * math.pi * torch.arange(num) / num
    heading = 0.03 * torch.stack([turn.cos(), turn.sin()], -1)
    clean = start[:, None] + torch.arange(16)[:, None] * heading[:, None]
    rows = torch.cat([torch.zeros(num, 1, 1), start[:, None]], dim=-1)
    windows = AbsoluteWindows(clean, torch.ones(num, 16, dtype=torch.bool), rows, torch.ones(num, 1, dtype=torch.bool))
    position = start.double()[:, None, None] * CONFIG.scale_m
    seen = Detections(
        torch.zeros(num, 1, 1).double(),
        position,
        torch.zeros(num, 1, 1, 2, 2).double(),
        torch.ones(num, 1, 1, dtype=torch.bool),
    )
    batch = WindowBatch(2.0 * torch.arange(16).double(), seen, torch.arange(num), 0)
    return windows, batch


def test_one_batch_is_learned_by_heart():
    """Conditioning works: the loss falls tenfold, and every window's samples follow its own track, not another's."""
    config = dataclasses.replace(CONFIG, network=dataclasses.replace(NETWORK, prediction="x0", activation="silu"))
    windows, at = lesson()
    many = join_absolute([windows] * 4)
    generator = torch.Generator().manual_seed(2)
    with torch.random.fork_rng():
        torch.random.default_generator.manual_seed(4)
        network = TrajectoryNetwork(config.network)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
    schedule = config.network.schedule()
    losses = []
    for step in range(150):
        optimiser.param_groups[0]["lr"] = 1e-2 * min(1.0, 2.0 * (1 - step / 150))
        loss = absolute_loss(network, many, schedule, generator)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert sum(losses[-20:]) / 20 < 0.1 * losses[0]
    centre = Context(torch.tensor([[100.0, 50.0]]).double().expand(8, 2))
    truth = windows.clean.double() * CONFIG.scale_m
    for sampling in (
        AbsoluteSampling("dpmpp", 8, "none"),
        AbsoluteSampling("ddpm", inpainting="overwrite"),
        AbsoluteSampling(),
    ):
        found = AbsoluteModel(network.eval(), config, sampling).sample(at.with_context(centre), 8).position_m[:, :, 0]
        error = (found - truth[:, None]).norm(dim=-1).mean()
        other = (found - truth.roll(1, 0)[:, None]).norm(dim=-1).mean()
        assert error < 30.0 and other > 3 * error


def test_unknown_steps_do_not_count():
    windows, _ = lesson()
    network = TrajectoryNetwork(NETWORK)
    schedule = NETWORK.schedule()
    is_known = windows.is_known.clone()
    is_known[:, 8:] = False
    hidden = dataclasses.replace(windows, is_known=is_known)
    moved = dataclasses.replace(hidden, clean=torch.where(is_known[..., None], windows.clean, 50.0))
    losses = [absolute_loss(network, w, schedule, torch.Generator().manual_seed(0)) for w in (hidden, moved)]
    assert torch.equal(*losses)
