"""Repair: nothing collides afterwards, detections stay exactly, what was free is not touched, steps stay plausible."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.constraints.motion import step_lengths
from cadence.constraints.obstacles import Obstacles
from cadence.constraints.placement import arc_length, place
from cadence.constraints.repair import repair

HILL = Obstacles(torch.tensor([[0.0, 0.0, 10.0]], dtype=torch.float64))
SQUARE = torch.tensor([[-10.0, -10.0], [10.0, -10.0], [10.0, 10.0], [-10.0, 10.0]], dtype=torch.float64)
BAY = torch.tensor([[-1, -1], [1, -1], [1, -0.6], [-0.6, -0.6], [-0.6, 0.6], [1, 0.6], [1, 1], [-1, 1]], dtype=torch.float64)


def line(start, end, num=41, dtype=torch.float64):
    share = torch.linspace(0, 1, num, dtype=dtype)[:, None]
    return torch.tensor(start, dtype=dtype) * (1 - share) + torch.tensor(end, dtype=dtype) * share


def unpinned(track):
    return torch.zeros(track.shape[:-1], dtype=torch.bool)


def pinned_at(track, *steps):
    pinned = unpinned(track)
    pinned[..., list(steps)] = True
    return pinned


def clearance(track, obstacles):
    dense = torch.linspace(0, 1, 50, dtype=torch.float64)[:, None]
    track = track.double()
    return obstacles.signed_distance(track[..., :-1, None, :] * (1 - dense) + track[..., 1:, None, :] * dense)[0].min()


def test_free_tracks_are_returned_as_they_are():
    track = torch.stack([line([-40, 20], [40, 20]), line([-40, 2], [40, 2])])
    moved, feasible = repair(track, HILL, unpinned(track))
    assert torch.equal(moved[0], track[0]) and not torch.equal(moved[1], track[1])
    assert feasible.tolist() == [True, True]
    same, feasible = repair(track, Obstacles.none(), unpinned(track))
    assert same is track and feasible.all()


@pytest.mark.parametrize("margin", [0.0, 3.0])
def test_shorter_way_round_a_circle_with_even_steps(margin):
    track = line([-40, 2], [40, 2])
    moved, feasible = repair(track, HILL, pinned_at(track, 0, 40), margin)
    assert feasible
    assert torch.equal(moved[[0, 40]], track[[0, 40]])
    assert moved[:, 1].min() >= 2 - 1e-9, "the upper side is nearer"
    assert clearance(moved, HILL) >= margin
    assert step_lengths(moved).max() < 1.4 * step_lengths(track).max()
    assert arc_length(moved.numpy())[-1] < 1.1 * 80


def test_the_side_where_most_of_the_track_is_wins():
    # Runs close below the top of the wall, then dips out of its side low: over the top is longer, but most of it is there.
    wall = Obstacles(torch.zeros(0, 3, dtype=torch.float64), ((SQUARE * torch.tensor([2.0, 1.0]),),))
    track = torch.cat([line([-24, -1.5], [-19, 8], 4), line([-17, 8], [14, 8], 32), line([16, 0], [25, -2], 5)])
    moved, feasible = repair(track, wall, pinned_at(track, 0, 40))
    assert feasible
    assert moved[10:30, 1].min() > 10


def test_pinned_steps_between_obstacles_are_kept():
    two = Obstacles(torch.tensor([[-15.0, 0.0, 10.0], [15.0, 0.0, 10.0]], dtype=torch.float64))
    track = line([-40, 1], [40, 1])
    moved, feasible = repair(track, two, pinned_at(track, 0, 20, 40), 1.0)
    assert feasible and torch.equal(moved[[0, 20, 40]], track[[0, 20, 40]])
    assert clearance(moved, two) > 0.9


def test_a_pinned_step_inside_is_left_and_the_rest_repaired():
    track = line([-40, 2], [40, 2])
    moved, feasible = repair(track, HILL, pinned_at(track, 0, 20, 40))
    assert not feasible
    assert torch.equal(moved[[0, 20, 40]], track[[0, 20, 40]])
    blocked = segments_in_collision(moved, HILL)
    assert blocked.nonzero().flatten().tolist() == [19, 20], "only the segments at the pinned step itself"


def test_no_room_in_time_is_infeasible():
    track = line([-40, 0], [40, 0], 2)
    moved, feasible = repair(track, HILL, torch.ones(2, dtype=torch.bool))
    assert not feasible and torch.equal(moved, track)


def test_one_free_step_is_enough_for_a_corner():
    track = line([-30, 1], [30, 1], 3)
    moved, feasible = repair(track, HILL, pinned_at(track, 0, 2))
    assert feasible and torch.equal(moved[[0, 2]], track[[0, 2]])


def test_a_track_that_ends_inside_walks_on_outside():
    track = line([-40, 3], [0, 3])
    moved, feasible = repair(track, HILL, pinned_at(track, 0), 1.0)
    assert feasible and torch.equal(moved[0], track[0])
    assert step_lengths(moved).max() < 1.3
    begins_inside, feasible = repair(track.flip(0), HILL, pinned_at(track, 40), 1.0)
    assert feasible and torch.equal(begins_inside[40], track[0])


def test_a_track_wholly_inside_comes_out():
    parked = torch.zeros(12, 2, dtype=torch.float64) + torch.tensor([3.0, 1.0])
    moved, feasible = repair(parked, HILL, unpinned(parked))
    assert feasible and step_lengths(moved).max() < 1e-9
    single, feasible = repair(parked[:1], HILL, unpinned(parked[:1]))
    assert feasible and HILL.signed_distance(single)[0] > 0


def test_a_bay_is_passed_by_unless_a_detection_lies_in_it():
    bay = Obstacles(torch.zeros(0, 3, dtype=torch.float64), ((BAY * 20,),))
    track = line([8, -40], [8, 40], 81)
    moved, feasible = repair(track, bay, pinned_at(track, 0, 80), 1.0)
    assert feasible and moved[30:50, 0].min() > 15
    seen, feasible = repair(track, bay, pinned_at(track, 0, 40, 80), 1.0)
    assert feasible and torch.equal(seen[40], track[40])


def test_a_walled_room_cannot_be_left():
    room = Obstacles(torch.zeros(0, 3, dtype=torch.float64), ((SQUARE, SQUARE * 0.5),))
    track = line([0, 0], [40, 0])
    moved, feasible = repair(track, room, pinned_at(track, 0, 40))
    assert not feasible and torch.equal(moved[[0, 40]], track[[0, 40]])
    stays, feasible = repair(track, room, pinned_at(track, 0))
    assert feasible and stays.abs().max() < 5


def test_overlapping_obstacles_are_one():
    chain = Obstacles(torch.tensor([[0.0, y, 6.0] for y in (-16, -8, 0, 8)], dtype=torch.float64), ((SQUARE * 0.3,),))
    track = line([-40, 0], [40, 0], 81)
    moved, feasible = repair(track, chain, pinned_at(track, 0, 80), 0.5)
    assert feasible and clearance(moved, chain) > 0.49


def test_offset_type_batch_and_nan():
    track = line([-40, 2], [40, 2], dtype=torch.float32).expand(2, 3, 41, 2).clone()
    track[1, 1] = math.nan
    offset = torch.tensor([[5e5, -2e5]], dtype=torch.float64)
    far = Obstacles(HILL.circles + torch.tensor([5e5, -2e5, 0.0], dtype=torch.float64))
    moved, feasible = repair(track, far, pinned_at(track, 0, 40), offset_m=offset)
    assert moved.dtype == torch.float32 and moved.shape == track.shape
    assert feasible.all() and moved[1, 1].isnan().all()
    assert not segments_in_collision(moved, far, offset_m=offset).any()
    near, _ = repair(track[0, 0], HILL, pinned_at(track[0, 0], 0, 40))
    torch.testing.assert_close(moved[0, 0], near, atol=1e-3, rtol=0)


def test_hypotheses_do_not_depend_on_their_neighbours():
    tracks = torch.stack([line([-40, y], [40, y]) for y in (-9.0, -4.0, 2.0, 7.0, 30.0)])
    together, _ = repair(tracks, HILL, pinned_at(tracks, 0, 40))
    for index, track in enumerate(tracks):
        alone, _ = repair(track, HILL, pinned_at(track, 0, 40))
        torch.testing.assert_close(together[index], alone, atol=1e-9, rtol=0)


def test_a_coast_of_many_vertices():
    angle = torch.arange(4000, dtype=torch.float64) / 4000 * 2 * math.pi
    radius = 1000 + 40 * torch.sin(60 * angle) + 10 * torch.sin(700 * angle)
    coast = Obstacles(
        torch.zeros(0, 3, dtype=torch.float64), ((torch.stack([radius * angle.cos(), radius * angle.sin()], dim=1),),)
    )
    track = torch.stack([line([-1500, y], [1500, y], 96) for y in (-700.0, 100.0, 800.0)])
    moved, feasible = repair(track, coast, pinned_at(track, 0, 95), 5.0)
    assert feasible.all() and not segments_in_collision(moved, coast).any()
    assert (step_lengths(moved).amax(dim=1) < 2 * step_lengths(track).amax(dim=1)).all()


def test_placement_hits_corners_and_keeps_the_rhythm():
    old = line([0, 0], [10, 0], 11).numpy()
    path = torch.tensor([[0.0, 0.0], [0.0, 3.3], [10.0, 3.3], [10.0, 0.0]], dtype=torch.float64).numpy()
    new = place(old, path, arc_length(path)[1:-1], arc_length(path)[-1])
    assert (new[[0, -1]] == path[[0, -1]]).all()
    for corner in path[1:-1]:
        assert abs(new - corner).sum(axis=1).min() < 1e-12
    assert place(old[:3], path, arc_length(path)[1:-1], arc_length(path)[-1]) is None


def random_obstacles(seed):
    """Up to ten circles, stars, bays and rooms close to each other, and 8 wandering tracks with some steps pinned."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    polygons = []
    for kind in torch.randint(0, 3, (int(torch.randint(0, 6, (1,), generator=g)),), generator=g).tolist():
        centre, size, turn = rand(2) * 1000, 40 + 150 * rand(1), 6.28 * rand(1)
        rotation = torch.stack([torch.cat([turn.cos(), -turn.sin()]), torch.cat([turn.sin(), turn.cos()])])
        angle = torch.arange(10, dtype=torch.float64) / 10 * 2 * math.pi
        star = (0.3 + 0.7 * rand(10))[:, None] * torch.stack([angle.cos(), angle.sin()], dim=1)
        rings = [(star,), (BAY,), (SQUARE / 10, SQUARE / 17)][kind]
        polygons.append(tuple(centre + size * ring @ rotation for ring in rings))
    num_circles = int(torch.randint(1, 6, (1,), generator=g))
    circles = torch.cat([rand(num_circles, 2) * 1000, 10 + 120 * rand(num_circles, 1)], dim=1)
    heading = torch.cumsum(0.3 * torch.randn(8, 48, generator=g, dtype=torch.float64), dim=1) + 6.28 * rand(8, 1)
    step = torch.stack([heading.cos(), heading.sin()], dim=-1) * (5 + 50 * rand(1))
    track = torch.cumsum(step, dim=1) + 1000 * rand(8, 1, 2)
    return Obstacles(circles, tuple(polygons)), track, rand(8, 48) < 0.2 * rand(1)


@given(seed=st.integers(0, 1_000_000), margin=st.sampled_from([0.0, 5.0, 25.0]), is_single=st.booleans())
def test_no_feasible_hypothesis_collides(seed, margin, is_single):
    obstacles, track, pinned = random_obstacles(seed)
    track = track.float() if is_single else track
    moved, feasible = repair(track, obstacles, pinned, margin)
    assert torch.isfinite(moved).all()
    assert torch.equal(moved[pinned], track[pinned])
    blocked = segments_in_collision(moved, obstacles).any(dim=1)
    assert torch.equal(feasible, ~blocked)
    if margin == 0:
        free = ~segments_in_collision(track, obstacles).any(dim=1)
        assert (moved == track).all(dim=-1).all(dim=-1)[free].float().mean().nan_to_num(1.0) > 0.9


def test_nearly_every_repairable_hypothesis_is_repaired():
    """Without pinned steps there is always a way; with some it fails only where walls or time forbid it."""
    repairable = repaired = 0
    for seed in range(40):
        obstacles, track, pinned = random_obstacles(seed)
        _, feasible = repair(track, obstacles, torch.zeros_like(pinned), 5.0)
        assert feasible.all()
        _, feasible = repair(track, obstacles, pinned, 5.0)
        has_way = ~(states_in_collision(track, obstacles) & pinned).any(dim=1)
        repairable, repaired = repairable + int(has_way.sum()), repaired + int(feasible[has_way].sum())
    assert repaired > 0.97 * repairable
