"""Windows of several agents through the place model: rows, absence, joint samples, shared detections, training."""

import dataclasses

import numpy as np
import pytest
import torch

from cadence.diffusion.place import PlaceModel
from cadence.diffusion.place_frame import PlaceConfig, place_inputs
from cadence.diffusion.place_team import agent_rows, shared_detections
from cadence.diffusion.settings import PlaceSampling
from cadence.errors import ConfigError
from cadence.network.attention import MAX_AGENTS
from cadence.network.frozen import FrozenPlace
from cadence.network.place import PlaceNetworkConfig
from cadence.recordings import ForecastWindows, Recordings, cut_windows
from cadence.training.place_losses import Dropout, diffusion_loss, energy_loss, place_windows
from cadence.types import Context, Detections, WindowBatch

SMALL = PlaceNetworkConfig(
    width=16, multipliers=(1, 2), encoder_size=8, code_size=16, level_size=8, max_detections=12, map_cells=8, map_channels=2
)
ALONE = PlaceConfig(SMALL, centre_m=(5000.0, 5000.0), scale_m=5000.0, unit_step_m=60.0, max_step_m=100.0)
TOGETHER = dataclasses.replace(ALONE, network=dataclasses.replace(SMALL, attention_heads=2))
SHARED = dataclasses.replace(TOGETHER, shared_gap_steps=100)


def recordings(num: int = 4, agents: int = 3) -> Recordings:
    """Straight walks of 80 m a step, the agents of an episode side by side."""
    rng = np.random.default_rng(0)
    tracks, lengths = [], []
    for steps in rng.integers(40, 150, num):
        heading = rng.uniform(0, 2 * np.pi)
        for agent in range(agents):
            way = 20.0 * np.arange(steps)[:, None] * np.array([np.cos(heading), np.sin(heading)])
            tracks.append(5000.0 + 300.0 * agent + way)
            lengths.append(int(steps))
    total = sum(lengths)
    return Recordings(
        60.0, np.concatenate([[0], np.cumsum(lengths)]), np.concatenate(tracks).astype(np.float32), rng.random(total) < 0.2,
        np.zeros((total, 0, 2), np.float32), np.full((num * agents, 2), np.nan, np.float32), agents,
    )  # fmt: skip


def windows() -> ForecastWindows:
    return cut_windows(recordings(), np.array([0, 1, 3]), np.array([20, 30, 25]))


def without(cut: ForecastWindows, window: int, agent: int) -> WindowBatch:
    """The windows, with one agent of one window never detected."""
    w = cut.windows
    is_observed = w.detections.is_observed.clone()
    is_observed[window, agent] = False
    d = dataclasses.replace(w.detections, is_observed=is_observed)
    return dataclasses.replace(w, detections=d)


def model(config: PlaceConfig) -> PlaceModel:
    torch.manual_seed(0)
    network = config.build()
    torch.nn.init.normal_(network.unet.head.weight, std=0.3)
    for across in network.unet.across:
        torch.nn.init.normal_(across.write.weight, std=0.3)
    return PlaceModel(network.eval(), config, PlaceSampling(num_steps=3))


def test_a_window_holds_all_agents_of_an_episode_and_each_as_if_alone() -> None:
    rec = recordings()
    cut = windows()
    assert cut.windows.num_agents == 3 and cut.truth_m.shape == (3, 3, 120, 2)
    single = dataclasses.replace(rec, num_agents=1)
    for agent in range(3):
        alone = cut_windows(single, cut.episode.numpy() * 3 + agent, cut.step.numpy())
        shift = (cut.context.datum_m - alone.context.datum_m)[:, None]
        d, mine = cut.windows.detections, alone.windows.detections
        count = mine.is_observed[:, 0].sum(1)
        assert torch.equal(d.is_observed[:, agent].sum(1), count)
        assert torch.allclose(cut.truth_m[:, agent] + shift, alone.truth_m[:, 0])
        for row, number in enumerate(count.tolist()):
            assert torch.allclose(d.position_m[row, agent, :number] + shift[row], mine.position_m[row, 0, :number])


def test_episodes_are_selected_whole_and_must_be_whole() -> None:
    rec = recordings()
    part = rec.select([2, 0])
    assert (part.num_episodes, len(part), part.num_agents) == (2, 6, 3)
    assert np.array_equal(part.position_m[: part.length[0]], rec.position_m[rec.offset[6] : rec.offset[7]])
    with pytest.raises(ValueError, match="no episodes of 2 agents"):
        dataclasses.replace(recordings(num=3), num_agents=2)
    with pytest.raises(ValueError, match="numbers of agents"):
        Recordings.concatenate([rec, dataclasses.replace(rec, num_agents=1)])


def test_rows_of_independent_agents_are_those_that_are_there() -> None:
    cut = windows()
    rows = agent_rows(without(cut, 1, 2), ALONE)
    assert rows.team is None and bool(rows.is_real.all())
    assert list(zip(rows.window.tolist(), rows.agent.tolist(), strict=True)) == [
        (0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2),
    ]  # fmt: skip
    together = agent_rows(without(cut, 1, 2), TOGETHER)
    assert together.team is not None and together.team.is_present.tolist() == [[True] * 3, [True, True, False], [True] * 3]
    assert together.is_real.tolist() == [True] * 5 + [False] + [True] * 3
    assert bool(together.windows.is_active.all())


@pytest.mark.parametrize("config", [ALONE, TOGETHER])
def test_an_absent_agent_changes_nothing_for_the_others_but_that_it_is_not_there(config: PlaceConfig) -> None:
    cut, estimator = windows(), model(config)
    drawn = estimator.sample(without(cut, 1, 2), 4)
    assert drawn.position_m.shape == (3, 4, 3, 120, 2)
    assert bool(drawn.position_m[1, :, 2].isnan().all()) and drawn.status[1] == ("ok", "ok", "no_detections")
    pair = dataclasses.replace(
        without(cut, 1, 2),
        detections=Detections(*(value[:, :2] for value in vars(cut.windows.detections).values() if value is not None)),
    )
    assert cut.context.known_goal_m is not None
    context = dataclasses.replace(cut.context, known_goal_m=cut.context.known_goal_m[:, :2])
    two = estimator.sample(pair.with_context(context), 4)
    assert torch.allclose(two.position_m[1], drawn.position_m[1, :, :2], atol=0.05)


def test_agents_see_each_other_where_there_is_attention() -> None:
    cut = windows()
    moved = cut.windows.detections.position_m.clone()
    moved[:, 2] += 1500.0
    elsewhere = dataclasses.replace(cut.windows, detections=dataclasses.replace(cut.windows.detections, position_m=moved))
    for config, sees in ((ALONE, False), (TOGETHER, True)):
        estimator = model(config)
        before, after = (estimator.sample(w, 3).position_m[:, :, :2] for w in (cut.windows, elsewhere))
        assert torch.allclose(before, after, atol=1e-3) != sees


def test_a_windows_draws_do_not_depend_on_its_neighbours_or_chunks() -> None:
    cut, estimator = windows(), model(TOGETHER)
    whole = estimator.sample(cut.windows, 4).position_m
    small = dataclasses.replace(estimator, sampling=dataclasses.replace(estimator.sampling, chunk=4))
    assert torch.allclose(small.sample(cut.windows, 4).position_m, whole, atol=0.05)
    pick = torch.tensor([2])
    alone = estimator.sample(cut.windows[pick], 4).position_m
    assert torch.allclose(alone, whole[2:], atol=0.05)


def test_laid_out_for_sampling_agents_see_each_other_as_in_the_network() -> None:
    cut, estimator = windows(), model(TOGETHER)
    rows = agent_rows(without(cut, 1, 2), TOGETHER)
    inputs = place_inputs(rows.windows, TOGETHER)
    frozen = FrozenPlace(estimator.network)
    noisy = torch.randn(2 * len(inputs), TOGETHER.num_pieces, 2, generator=torch.Generator().manual_seed(0))
    twice = inputs.repeated(2)
    assert rows.team is not None
    team = rows.team.repeated(2)
    with torch.no_grad():
        code = estimator.network.encode(twice)
        expected = estimator.network(noisy, torch.full((len(noisy),), 0.7), twice.pieces, code, team)
        found = frozen(noisy, 0.7, twice.pieces, frozen.known(inputs), team)
        alone = frozen(noisy, 0.7, twice.pieces, frozen.known(inputs))
    assert torch.allclose(found, expected, atol=1e-4)
    assert not torch.allclose(alone, expected, atol=1e-3)


def test_shared_detections_are_those_of_all_by_time() -> None:
    cut = windows()
    shared = shared_detections(cut.windows).detections
    d = cut.windows.detections
    assert bool((shared.is_observed == shared.is_observed[:, :1]).all())
    assert torch.equal(shared.count[:, 0], d.count.sum(dim=1))
    for window in range(3):
        count = int(shared.count[window, 0])
        times = shared.time_s[window, 0, :count]
        assert bool((times.diff() >= 0).all()) and bool(shared.is_observed[window, 0, :count].all())
        expected = d.position_m[window][d.is_observed[window]]
        assert torch.equal(shared.position_m[window, 1, :count].sort(0).values, expected.sort(0).values)


def test_with_shared_detections_every_agent_is_drawn() -> None:
    cut = windows()
    drawn = model(SHARED).sample(without(cut, 1, 2).with_context(cut.context), 3)
    assert bool(drawn.position_m.isfinite().all()) and drawn.status[1] == ("ok", "ok", "ok")


@pytest.mark.parametrize("config", [TOGETHER, SHARED])
def test_training_windows_are_the_truth_and_absent_agents_cost_nothing(config: PlaceConfig) -> None:
    rec, rng = recordings(), np.random.default_rng(0)
    rows = rec.offset[[0, 3, 6, 9, 0, 3]] + np.array([2, 3, 2, 4, 30, 5])  # early: not everybody was detected yet
    found = place_windows(rec, rows, config, Dropout(known_start=0.0), rng)
    assert found.team is not None and len(found) == 3 * len(found.team.is_present)
    assert config.shared_gap_steps or not bool(found.is_real.all())  # otherwise this tests nothing
    network = model(dataclasses.replace(config, few_steps=2)).network
    few = dataclasses.replace(config, few_steps=2)
    worse = dataclasses.replace(found, clean=torch.where(found.is_real[:, None, None], found.clean, found.clean + 1.0))
    for part in (found, worse):
        assert len(part) == sum(len(piece) for piece in part.parts(4))

    def losses(part: object) -> list[float]:
        generator = [torch.Generator().manual_seed(0) for _ in range(2)]
        return [
            float(diffusion_loss(network, part, config, 1.0, generator[0])),  # type: ignore[arg-type]
            float(energy_loss(network, part, few, 2, (0.3, 0.3), generator[1])),  # type: ignore[arg-type]
        ]

    with torch.no_grad():
        assert losses(found) == pytest.approx(losses(worse), rel=1e-5)


def test_a_goal_that_is_told_goes_with_its_agent() -> None:
    cut = windows()
    goal = torch.arange(18, dtype=torch.float64).reshape(3, 3, 2)
    told = cut.with_context(dataclasses.replace(cut.context, known_goal_m=goal))
    context = agent_rows(told.windows, TOGETHER).windows.context
    assert isinstance(context, Context) and context.known_goal_m is not None
    assert torch.equal(context.known_goal_m[:, 0], goal.reshape(9, 2))


def test_more_agents_than_can_attend_to_each_other_are_refused_in_a_line() -> None:
    crowd = cut_windows(recordings(num=1, agents=MAX_AGENTS + 1), np.array([0]), np.array([30]))
    with pytest.raises(ConfigError, match=f"at most {MAX_AGENTS} agents together, here are {MAX_AGENTS + 1}"):
        model(TOGETHER).sample(crowd.windows, 1)
    drawn = model(ALONE).sample(crowd.windows, 1)
    assert drawn.position_m.shape[2] == MAX_AGENTS + 1
