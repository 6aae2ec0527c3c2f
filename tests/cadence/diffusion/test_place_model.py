"""The place model: how tracks are stated, what the network is told, sampling, and its two losses."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from cadence import metrics
from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.place import PlaceModel
from cadence.diffusion.place_frame import PlaceConfig, future_of, place_inputs, recorded_track, to_pieces, to_track
from cadence.diffusion.settings import PlaceSampling
from cadence.errors import ConfigError
from cadence.evidence.estimator import with_past
from cadence.network.place import PlaceNetworkConfig
from cadence.recordings import ForecastWindows, Recordings, cut_windows
from cadence.training import place_losses as training
from cadence.training.place_losses import Dropout, PlaceWindows, diffusion_loss, energy_loss, few_step_sample, place_windows
from cadence.types import Context

SMALL = PlaceNetworkConfig(
    width=16, multipliers=(1, 2), encoder_size=8, code_size=16, level_size=8, max_detections=12, map_cells=8, map_channels=2
)
CONFIG = PlaceConfig(SMALL, centre_m=(5000.0, 5000.0), scale_m=5000.0, unit_step_m=60.0, max_step_m=100.0, stride=4)


def recordings(num: int = 6, seed: int = 0) -> Recordings:
    """Straight walks of 80 m a step in all directions from the middle, and three trackers somewhere."""
    rng = np.random.default_rng(seed)
    length = rng.integers(30, 200, num)
    tracks = []
    for steps in length:
        heading = rng.uniform(0, 2 * np.pi)
        tracks.append(5000.0 + 20.0 * np.arange(steps)[:, None] * np.array([np.cos(heading), np.sin(heading)]))
    total = int(length.sum())
    return Recordings(
        60.0,
        np.concatenate([[0], np.cumsum(length)]),
        np.concatenate(tracks).astype(np.float32),
        rng.random(total) < 0.2,
        rng.uniform(0, 1e4, (total, 3, 2)).astype(np.float32),
        rng.uniform(0, 1e4, (num, 2)).astype(np.float32),
    )


def windows(num: int = 8) -> ForecastWindows:
    rec, rng = recordings(), np.random.default_rng(1)
    episode = rng.integers(0, len(rec), num)
    return cut_windows(rec, episode, (rng.random(num) * rec.length[episode]).astype(np.int64))


def model(sampling: PlaceSampling | None = None, config: PlaceConfig = CONFIG, std: float = 0.3) -> PlaceModel:
    torch.manual_seed(0)
    network = config.build()
    torch.nn.init.normal_(network.unet.head.weight, std=std)
    return PlaceModel(network.eval(), config, sampling or PlaceSampling(num_steps=3))


def test_a_track_is_the_sum_of_its_pieces() -> None:
    cut, rec = windows(), recordings()
    inputs = place_inputs(cut.windows, CONFIG)
    rows = rec.offset[cut.episode.numpy()] + cut.step.numpy()
    track = recorded_track(rec, rows, cut.episode.numpy(), inputs.pieces)
    pieces = to_pieces(track, inputs.pieces, CONFIG)
    again = to_track(pieces[:, None].double(), inputs.pieces, CONFIG)[:, 0]
    assert torch.allclose(again, track - track[:, :1], atol=0.01)
    # the walks are straight, so that pieces lose nothing but the moment of stopping
    error = (future_of(again, CONFIG) - cut.truth_m[:, 0]).norm(dim=-1)
    assert float(error.max()) <= 0.5 * CONFIG.stride * 20.0 and float(error.median()) < 0.05


def test_inputs_do_not_depend_on_padding_or_neighbours() -> None:
    cut = windows()
    together = place_inputs(cut.windows, CONFIG)
    for row in range(len(cut)):
        one = cut[row : row + 1]
        alone = place_inputs(one.windows, CONFIG)
        assert torch.equal(alone.summary, together.summary[row : row + 1])
        count = int(alone.is_observed.sum())
        assert torch.equal(alone.rows[0, :count], together.rows[row, :count])
        assert int(together.is_observed[row].sum()) == count


def test_all_detections_are_read_where_they_fit_and_otherwise_the_last_ones_and_the_first() -> None:
    rec = recordings()
    rec.is_detected[:] = True
    cut = cut_windows(rec, np.array([2, 2]), np.array([6, 25]))
    inputs = place_inputs(cut.windows, CONFIG)
    ages = (inputs.rows[..., 1] * 200.0).round()
    assert ages[0, :7].tolist() == list(range(6, -1, -1)) and int(inputs.is_observed[0].sum()) == 7
    assert ages[1, 0] == 25 and ages[1, -8:].tolist() == list(range(7, -1, -1)) and bool(inputs.is_observed[1].all())
    assert bool((ages[1].diff() < 0).all())


def test_trackers_are_a_set_and_a_goal_that_is_not_told_is_none() -> None:
    cut, network = windows(), model().network
    context = cut.context
    assert context.tracker_m is not None and context.known_goal_m is not None

    def code(**changes: object) -> torch.Tensor:
        return network.encode(place_inputs(cut.windows.with_context(dataclasses.replace(context, **changes)), CONFIG)).detach()

    assert torch.allclose(code(), code(tracker_m=context.tracker_m[:, :, [2, 0, 1]]), atol=1e-5)
    assert not torch.allclose(code(), code(tracker_m=context.tracker_m + 500.0), atol=1e-3)
    absent = torch.nan * context.tracker_m
    assert torch.allclose(code(tracker_m=None), code(tracker_m=absent), atol=1e-6)
    assert torch.allclose(code(known_goal_m=None), code(known_goal_m=torch.nan * context.known_goal_m), atol=1e-6)
    assert not torch.allclose(code(), code(known_goal_m=None), atol=1e-3)


def moved(cut: ForecastWindows, by_m: float) -> ForecastWindows:
    """The same windows elsewhere on the map, with all that belongs to them."""
    c = cut.context
    assert c.known_goal_m is not None and c.tracker_m is not None
    there = dataclasses.replace(c, datum_m=c.datum_m + by_m, known_goal_m=c.known_goal_m + by_m, tracker_m=c.tracker_m + by_m)
    return cut.with_context(there)


def test_places_are_told_as_they_should_be_and_a_network_may_do_without_a_map() -> None:
    cut = windows()
    tracks = {}
    for places in ("both", "relative", "absolute"):
        small = dataclasses.replace(SMALL, places=places, map_channels=0)  # type: ignore[arg-type]
        config = dataclasses.replace(CONFIG, network=small)
        found = model(config=config)
        tracks[places] = [found.sample(c.windows, 2).position_m for c in (cut, moved(cut, 800.0))]
        inputs = place_inputs(cut.windows, config)
        is_offset, is_place = (bool(inputs.rows[..., columns].any()) for columns in (slice(4, 6), slice(2, 4)))
        assert (is_offset, is_place) == (places != "absolute", places != "relative")
    assert torch.allclose(*tracks["relative"], atol=0.5)  # without a map it does not know where it is
    assert not torch.allclose(*tracks["absolute"], atol=20.0)
    with_map = model(config=dataclasses.replace(CONFIG, network=dataclasses.replace(SMALL, places="relative")))
    here, there = (with_map.sample(c.windows, 2).position_m for c in (cut, moved(cut, 800.0)))
    assert not torch.allclose(here, there, atol=0.5)


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpmpp", "few"])
def test_hypotheses_belong_to_their_window(sampler: str) -> None:
    cut = windows()
    config = dataclasses.replace(CONFIG, few_steps=2 if sampler == "few" else 0)
    found = model(PlaceSampling(sampler=sampler, num_steps=3), config)  # type: ignore[arg-type]
    together = found.sample(cut.windows, 3).position_m
    assert together.shape == (8, 3, 1, 120, 2) and bool(together.isfinite().all())
    pick = torch.tensor([5, 2])
    alone = found.sample(cut.windows[pick], 3).position_m
    assert torch.allclose(alone, together[pick], atol=0.5)
    step = together.diff(dim=-2).norm(dim=-1)
    assert float(step.max()) <= CONFIG.max_step_m * 1.0001
    is_now = cut.windows.detections.time_s[:, 0].gather(1, (cut.windows.detections.count[:, 0] - 1)[:, None])[:, 0] == 0
    assert bool(is_now.any())
    assert torch.allclose(
        together[is_now, :, 0, 0], torch.zeros(1, dtype=torch.float64), atol=1e-6
    )  # the datum is the detection


def test_nothing_is_said_of_windows_without_detections() -> None:
    rec = recordings()
    rec.is_detected[rec.offset[1] : rec.offset[2]] = False
    cut = cut_windows(rec, np.array([1, 2]), np.array([3, 29]), known_start=False)
    found = model().sample(cut.windows, 2)
    assert bool(found.position_m[0].isnan().all()) and bool(found.position_m[1].isfinite().all())
    assert found.status == (("no_detections",), ("ok",))


def test_no_track_leaves_a_map_that_ends_somewhere() -> None:
    low, high = torch.tensor([3500.0, 3500.0]).double(), torch.tensor([6500.0, 6500.0]).double()
    cut = windows(24)
    place = {}
    for edge_m in (None, (3500.0, 3500.0, 6500.0, 6500.0)):
        drawn = model(config=dataclasses.replace(CONFIG, edge_m=edge_m)).sample(cut.windows, 4).position_m[:, :, 0]
        place[edge_m is None] = drawn + cut.context.datum_m[:, None, None]
    seen = cut.windows.detections
    last = seen.position_m[:, 0].gather(1, (seen.count[:, 0] - 1)[:, None, None].expand(-1, 1, 2))[:, 0].double()
    last = last + cut.context.datum_m
    is_on_map = ((last >= low) & (last <= high)).all(-1)
    assert 0 < int(is_on_map.sum()) < 24
    assert bool(((place[True] < low) | (place[True] > high)).any())
    assert bool(((place[False] >= low) & (place[False] <= high))[is_on_map].all())
    # who was seen beyond the edge was there: the map reaches as far
    beyond = place[False][~is_on_map]
    widest = torch.minimum(low, last)[~is_on_map, None, None], torch.maximum(high, last)[~is_on_map, None, None]
    assert bool(((beyond >= widest[0] - 1e-6) & (beyond <= widest[1] + 1e-6)).all())


@pytest.mark.parametrize("guidance", ["none", "final", "clean", "paper"])
def test_guidance_and_repair_keep_out_of_obstacles(guidance: str) -> None:
    circles = torch.tensor([[6500.0, 5000.0, 700.0], [3500.0, 5000.0, 700.0], [5000.0, 6500.0, 700.0]], dtype=torch.float64)
    walls, cut = Obstacles(circles, ()), windows(24)
    cut = cut[torch.nonzero((cut.context.datum_m[:, None] - circles[:, :2]).norm(dim=-1).min(dim=1).values > 750.0)[:, 0]]
    shares = {}
    for is_repaired in (False, True):
        sampling = PlaceSampling(sampler="ddpm", num_steps=10, guidance=guidance, is_repaired=is_repaired)  # type: ignore[arg-type]
        walled = cut.with_context(dataclasses.replace(cut.context, obstacles=walls))
        found = model(sampling, std=0.05).sample(walled.windows, 4).position_m
        offset = cut.context.datum_m[:, None, None, None]
        hit = states_in_collision(found, walls, offset_m=offset)
        crossing = segments_in_collision(found, walls, offset_m=offset)
        shares[is_repaired] = (float(hit.double().mean()), float(crossing.double().mean()))
    free = model(PlaceSampling(sampler="ddpm", num_steps=10), std=0.05).sample(cut.windows, 4).position_m
    unguided = float(states_in_collision(free, walls, offset_m=cut.context.datum_m[:, None, None, None]).double().mean())
    assert unguided > 0.01
    if guidance in ("final", "clean"):
        assert shares[False][0] < 0.4 * unguided
    assert shares[True][0] < 0.02 * unguided and shares[True][1] < 0.02


def test_reading_the_detections_again_and_rounding_change_little() -> None:
    cut = windows()
    plain = model(PlaceSampling(num_steps=3)).sample(cut.windows, 3).position_m
    again = model(PlaceSampling(num_steps=3, encode_each_step=True)).sample(cut.windows, 3).position_m
    assert torch.allclose(plain, again, atol=0.5)
    rounded = model(PlaceSampling(num_steps=3, precision="bfloat16")).sample(cut.windows, 3).position_m
    difference = (rounded - plain).norm(dim=-1)
    assert 0.0 < float(difference.mean()) < 0.2 * CONFIG.unit_step_m


def test_refusals_name_what_to_do() -> None:
    cut = windows()
    with pytest.raises(ConfigError, match="step_s = 60"):
        model().sample(dataclasses.replace(cut.windows, time_s=cut.windows.time_s * 2).with_context(cut.context), 2)
    with pytest.raises(ConfigError, match="not tuned"):
        model(PlaceSampling(sampler="few")).sample(cut.windows, 2)
    with pytest.raises(ConfigError, match=r"'ddim', but .* 2 steps"):
        tuned = dataclasses.replace(CONFIG, few_steps=2)
        model(PlaceSampling(sampler="ddim"), tuned).sample(cut.windows, 2)
    with pytest.raises(ValueError, match="where they are"):
        model().sample(cut.windows.with_context(None), 2)
    with pytest.raises(ValueError, match="ddpm"):
        PlaceSampling(sampler="ddim", guidance="paper")
    with pytest.raises(ValueError, match="reach"):
        PlaceConfig(num_future=16)


def training_windows(num: int = 16) -> PlaceWindows:
    rec, rng = recordings(), np.random.default_rng(2)
    return place_windows(rec, rng.integers(0, len(rec.position_m), num), CONFIG, Dropout(), rng)


def test_what_is_told_follows_the_shares() -> None:
    rec, rng = recordings(), np.random.default_rng(3)
    rows = rng.integers(0, len(rec.position_m), 400)
    found = place_windows(rec, rows, CONFIG, Dropout(1.0, 0.25, 0.5), rng)
    assert len(found) == 400
    assert abs(float((found.inputs.is_tracker.sum(dim=1) > 0).float().mean()) - 0.5) < 0.1
    assert len(place_windows(rec, rows, CONFIG, Dropout(0.0, 0.0, 0.0), rng)) < 400  # before the first detection


def test_of_a_source_there_may_be_no_window_at_all() -> None:
    rec = recordings()
    unseen = dataclasses.replace(rec, is_detected=np.zeros_like(rec.is_detected))
    rng = np.random.default_rng(0)
    found = place_windows(unseen, np.array([30, 50]), CONFIG, Dropout(known_start=0.0), rng)
    assert len(found) == 0 and found.clean.shape == (0, CONFIG.num_pieces, 2)


def test_both_losses_fall_on_one_batch() -> None:
    batch, config = training_windows(), dataclasses.replace(CONFIG, few_steps=2)
    for objective in ("diffusion", "energy"):
        torch.manual_seed(1)
        network = config.build()
        adam = torch.optim.Adam(network.parameters(), lr=1e-2)
        losses = []
        for step in range(40):
            generator = torch.Generator().manual_seed(step)
            if objective == "diffusion":
                loss = diffusion_loss(network, batch, config, 1.0, generator)
            else:
                loss = energy_loss(network, batch, config, 3, (0.3, 0.3), generator)
            adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
            losses.append(float(loss.detach()))
        assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:5]), objective


def test_the_energy_score_is_the_unbiased_one() -> None:
    torch.manual_seed(3)
    found, truth = torch.randn(5, 6, 1, 2).double(), torch.randn(5, 1, 2).double()
    mine = training._energy_score(found, truth)[:, 0]
    weight = torch.full((5, 6), 1 / 6, dtype=torch.float64)
    fair = metrics.energy_score(found[:, :, None], weight, truth[:, None], is_fair=True)[:, 0, 0]
    assert torch.allclose(mine, fair, atol=1e-4)


def test_the_few_steps_of_training_are_those_of_sampling() -> None:
    cut, config = windows(), dataclasses.replace(CONFIG, few_steps=2)
    plain = PlaceSampling(guidance="none", is_antithetic=False)
    free = dataclasses.replace(model(config=config), sampling=plain)
    free = dataclasses.replace(free, config=dataclasses.replace(config, max_step_m=1e9))
    drawn = free.sample(cut.windows, 2).position_m[:, :, 0]
    inputs = place_inputs(cut.windows, config)
    noise = torch.stack([torch.randn(2, 40, 2, generator=torch.Generator().manual_seed(int(s))) for s in cut.windows.seeds])
    with torch.no_grad():
        code = free.network.encode(inputs).repeat_interleave(2, dim=0)
        pieces = few_step_sample(free.network, inputs.pieces.repeated(2), code, noise.flatten(0, 1), 2)
    track = to_track(pieces.reshape(8, 2, 40, 2).double(), inputs.pieces, config)
    assert torch.allclose(future_of(track, config), drawn, atol=0.5)


def test_every_second_hypothesis_begins_with_mirrored_noise() -> None:
    """A network that answers nothing leaves the noise as it is, but for its length."""
    cut = windows()
    for sampler, is_mirrored in (("dpmpp", True), ("ddim", True), ("ddpm", False)):
        silent = model(PlaceSampling(sampler=sampler, num_steps=3), std=0.0)  # type: ignore[arg-type]
        tracks = silent.sample(cut.windows, 5).position_m[:, :, 0]
        middle = 0.5 * (tracks[:, 0:4:2] + tracks[:, 1:4:2])[:, :, :40]
        spread = (tracks[:, 0:4:2] - tracks[:, 1:4:2])[:, :, :40]
        assert tracks.shape[1] == 5 and bool((spread.norm(dim=-1) > 0.1).any())
        same = middle[:, :1].expand_as(middle)  # where the last detection and nothing else leads
        assert torch.allclose(middle, same, atol=0.5) == is_mirrored, sampler
    alone = model(PlaceSampling(num_steps=3, is_antithetic=False), std=0.0)
    tracks = alone.sample(cut.windows, 4).position_m[:, :, 0]
    assert not torch.allclose(tracks[:, 0] + tracks[:, 1], tracks[:, 2] + tracks[:, 3], atol=20.0)


def test_contexts_are_checked() -> None:
    with pytest.raises(ValueError, match="tracker_m"):
        Context(torch.zeros(2, 2), tracker_m=torch.zeros(2, 3, 2))
    assert Context(torch.zeros(4, 2), elapsed_s=torch.arange(4.0))[torch.tensor([2])].elapsed_s == torch.tensor([2.0])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"num_future": 29}, "120 steps"),
        ({"num_gap": 0}, "num_gap be at least 1"),
        ({"max_step_m": 0.0}, "must be positive"),
        ({"few_steps": -1}, "must not be negative"),
        ({"num_gap": 7}, "multiple of 2"),
    ],
)
def test_settings_of_sampling_that_cannot_be(changes: dict[str, float], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        dataclasses.replace(CONFIG, **changes)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"guidance": "paper", "sampler": "dpmpp"}, "ddpm"),
        ({"num_steps": 0}, "at least 1"),
        ({"margin_m": -1.0}, "not negative"),
    ],
)
def test_settings_of_the_sampling_that_cannot_be(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        PlaceSampling(**settings)


def test_a_grid_that_begins_before_now_shows_the_way_from_the_last_detection() -> None:
    batch = windows(3).windows
    estimator = model()
    plain = estimator.sample(batch, 4)
    found = estimator.sample(with_past(batch, 12), 4)
    assert torch.equal(found.position_m[..., 12:, :], plain.position_m)
    age = -torch.where(batch.detections.is_observed, batch.detections.time_s, -torch.inf).amax(-1) / batch.step_s
    for row in range(3):
        for agent in range(batch.num_agents):
            past = found.position_m[row, :, agent, :12]  # three windows of one agent
            is_there = torch.arange(-12, 0) >= -float(age[row, agent]) - 1e-6
            assert torch.equal(past[0, :, 0].isfinite(), is_there)
            steps = found.position_m[row, :, agent].diff(dim=-2).norm(dim=-1)
            assert float(steps[steps.isfinite()].max()) < 1.01 * CONFIG.max_step_m
