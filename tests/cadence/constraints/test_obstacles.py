"""Obstacles: distances by hand, gradients by finite differences, the checker against dense sampling."""

import math
import time

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.constraints.obstacles import ObstacleConstraint, Obstacles

SQUARE = torch.tensor([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]], dtype=torch.float64)


def circles(*rows):
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)


def points(*rows, dtype=torch.float64):
    return torch.tensor(rows, dtype=dtype)


def some_obstacles(seed, num_circles=3, num_polygons=3):
    """Circles and star-shaped (mostly concave) polygons, some overlapping, in a square of 100."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    stars = []
    for _ in range(num_polygons):
        angle = torch.arange(9, dtype=torch.float64) / 9 * 2 * math.pi
        radius = (5 + 15 * rand(1)) * (0.3 + 0.7 * rand(9))
        stars.append((rand(2) * 100 + radius[:, None] * torch.stack([angle.cos(), angle.sin()], dim=1),))
    return Obstacles(torch.cat([rand(num_circles, 2) * 100, 2 + 12 * rand(num_circles, 1)], dim=1), tuple(stars))


def test_distance_and_gradient_of_a_circle():
    distance, gradient = Obstacles(circles([1, 2, 5])).signed_distance(points([1, 12], [4, 2], [1, 7]))
    assert distance.tolist() == pytest.approx([5, -2, 0])
    assert gradient.tolist() == [[0, 1], [1, 0], [0, 1]]


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 2, 1, 0], [0, 1, 2, 3, 0]])
def test_distance_and_gradient_of_a_polygon_in_any_direction(order):
    obstacles = Obstacles(circles(), ((SQUARE[order],),))
    distance, gradient = obstacles.signed_distance(points([5, 12], [5, 9], [13, 14], [-1, 5], [2, 5], [5, 10]))
    assert distance.tolist() == pytest.approx([2, -1, 5, 1, -2, 0])
    expected = points([0, 1], [0, 1], [0.6, 0.8], [-1, 0], [-1, 0], [0, 1])
    torch.testing.assert_close(gradient, expected)


def test_a_hole_is_free():
    obstacles = Obstacles(circles(), ((SQUARE, SQUARE * 0.4 + 3),))
    distance, gradient = obstacles.signed_distance(points([5, 5], [6.5, 5], [8, 5], [7.5, 5]))
    assert distance.tolist() == pytest.approx([2, 0.5, -1, -0.5])
    torch.testing.assert_close(gradient[1:], points([-1, 0], [-1, 0], [-1, 0]), atol=1e-12, rtol=0)


def test_union_is_the_deepest_obstacle():
    obstacles = Obstacles(circles([0, 0, 5], [3, 0, 4]), ((SQUARE,),))
    distance, _ = obstacles.signed_distance(points([2, 0.5]))
    assert distance.item() == pytest.approx(min(math.hypot(2, 0.5) - 5, math.hypot(1, 0.5) - 4, -0.5))


def test_everything_is_finite_at_the_singular_points():
    obstacles = Obstacles(circles([20, 20, 5]), ((SQUARE,),))
    singular = points([20, 20], [25, 20], [0, 0], [10, 10], [5, 0], [0, 5], [5, 5])
    distance, gradient = obstacles.signed_distance(singular)
    assert torch.isfinite(distance).all()
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(7, dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_shape_and_type_follow_the_positions(dtype):
    distance, gradient = some_obstacles(1).signed_distance(torch.rand(2, 3, 4, 2, dtype=dtype) * 100)
    assert distance.shape == (2, 3, 4) and gradient.shape == (2, 3, 4, 2)
    assert distance.dtype == gradient.dtype == dtype


@pytest.mark.parametrize("seed", range(5))
def test_gradient_is_that_of_the_distance(seed):
    obstacles, step = some_obstacles(seed), 1e-6
    position = torch.rand(300, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 120 - 10
    _, gradient = obstacles.signed_distance(position)
    ahead = [obstacles.signed_distance(position + step * points(axis))[0] for axis in ([1, 0], [0, 1])]
    behind = [obstacles.signed_distance(position - step * points(axis))[0] for axis in ([1, 0], [0, 1])]
    numeric = (torch.stack(ahead, -1) - torch.stack(behind, -1)) / (2 * step)
    # Where two boundaries are equally near there is no gradient: the difference then is not a unit vector.
    smooth = (numeric.norm(dim=-1) - 1).abs() < 1e-6
    assert smooth.float().mean() > 0.98
    torch.testing.assert_close(gradient[smooth], numeric[smooth], atol=1e-5, rtol=0)


def test_offset_and_limit():
    obstacles, position = some_obstacles(2), torch.rand(50, 2, dtype=torch.float64) * 100
    offset = points([40, -30])
    full, slope = obstacles.signed_distance(position)
    shifted, _ = obstacles.signed_distance(position - offset, offset_m=offset)
    torch.testing.assert_close(shifted, full)
    limited, limited_slope = obstacles.signed_distance(position, limit_m=4.0)
    torch.testing.assert_close(limited, full.clamp_max(4.0))
    torch.testing.assert_close(limited_slope, torch.where((full < 4.0)[:, None], slope, 0.0))


def test_nan_and_no_obstacles():
    distance, gradient = some_obstacles(0).signed_distance(points([math.nan, 1.0]), limit_m=3.0)
    assert distance.tolist() == [3.0] and gradient.tolist() == [[0.0, 0.0]]
    distance, gradient = Obstacles.none().signed_distance(points([1.0, 1.0]))
    assert distance.tolist() == [math.inf] and gradient.tolist() == [[0.0, 0.0]]


def test_translation_changes_nothing():
    obstacles, position = some_obstacles(4), torch.rand(100, 2, dtype=torch.float64) * 100
    far = points([4e5, -3e5])
    moved = Obstacles(obstacles.circles + torch.cat([far[0], torch.zeros(1)]), tuple((r + far,) for (r,) in obstacles.polygons))
    torch.testing.assert_close(moved.signed_distance(position + far), obstacles.signed_distance(position), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "bad",
    [
        lambda: Obstacles(circles([0, 0, 0])),
        lambda: Obstacles(circles([0, math.nan, 1])),
        lambda: Obstacles(torch.zeros(3)),
        lambda: Obstacles(circles(), ((SQUARE[:2],),)),
        lambda: Obstacles(circles(), ((SQUARE[[0, 0, 1, 1]],),)),
        lambda: Obstacles(circles(), ((SQUARE[[0, 2, 1, 3]],),)),
        lambda: Obstacles(circles(), ((SQUARE * math.inf,),)),
        lambda: Obstacles(circles(), ((),)),
    ],
)
def test_meaningless_obstacles_are_refused(bad):
    with pytest.raises(ValueError, match="Obstacles"):
        bad()


def test_constraint_gradient_is_that_of_its_cost():
    constraint = ObstacleConstraint(some_obstacles(3), margin_m=4.0)
    position = (torch.rand(2, 40, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 100).requires_grad_()
    constraint.cost(position).sum().backward()
    torch.testing.assert_close(position.grad, constraint.gradient(position))
    assert constraint.cost(position).shape == (2,)
    # Circles that do not overlap: no kinks but the margin, where the hinge is smooth.
    smooth = ObstacleConstraint(Obstacles(circles([20, 20, 15], [70, 60, 18])), margin_m=4.0)
    assert torch.autograd.gradcheck(smooth.cost, (position,), atol=1e-5)


def test_a_unit_step_ends_on_the_margin():
    constraint = ObstacleConstraint(Obstacles(circles([0, 0, 5])), margin_m=2.0)
    position = points([[1.0, 0.0], [0.0, 6.0], [9.0, 0.0]])
    moved = position - constraint.gradient(position)
    torch.testing.assert_close(moved, points([[7.0, 0.0], [0.0, 7.0], [9.0, 0.0]]))


def test_mountain_cost_is_the_papers():
    obstacles = Obstacles(circles([0, 0, 10]))
    track = points([0, 0], [5, 0], [20, 0], [0, 10]).requires_grad_()
    cost = obstacles.mountain_cost(track)
    assert cost.item() == pytest.approx((1 + 0.5) / 4)
    cost.backward()
    assert torch.isfinite(track.grad).all()
    square = Obstacles(circles(), ((SQUARE,),))
    assert square.mountain_cost(points([5, 5])[None]).item() == pytest.approx(1)
    assert Obstacles.none().mountain_cost(track).item() == 0


def test_checker_by_hand():
    obstacles = Obstacles(circles([20, 5, 3]), ((SQUARE, SQUARE * 0.4 + 3),))
    track = points([-5, 5], [5, 5], [6, 6], [15, 5], [25, 5], [25, 20], [10, 20], [10, 10])
    assert segments_in_collision(track, obstacles).tolist() == [True, False, True, True, False, False, True]
    assert states_in_collision(track, obstacles).tolist() == [False] * 7 + [True]


def test_checker_edge_cases():
    obstacles = some_obstacles(0)
    assert segments_in_collision(torch.zeros(2, 1, 2), obstacles).shape == (2, 0)
    assert not segments_in_collision(torch.full((2, 5, 2), math.nan), obstacles).any()
    assert not states_in_collision(torch.full((2, 5, 2), math.nan), obstacles).any()
    assert not segments_in_collision(torch.rand(3, 4, 5, 2) * 100, Obstacles.none()).any()
    parked = torch.zeros(1, 4, 2)
    assert segments_in_collision(parked, Obstacles(circles([0, 0, 1]))).all()
    half = torch.tensor([[math.nan, math.nan], [50.0, 50.0], [50.0, 50.0]])
    assert segments_in_collision(half, Obstacles(circles([50, 50, 1]))).tolist() == [False, True]


@given(seed=st.integers(0, 10_000))
def test_checker_agrees_with_dense_sampling(seed):
    obstacles = some_obstacles(seed)
    g = torch.Generator().manual_seed(seed)
    track = torch.rand(6, 5, 2, generator=g, dtype=torch.float64) * 120 - 10
    offset = torch.rand(6, 1, 2, generator=g, dtype=torch.float64) * 10
    share = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None]
    absolute = track + offset
    sampled = absolute[:, :-1, None] * (1 - share) + absolute[:, 1:, None] * share
    nearest = obstacles.signed_distance(sampled)[0].amin(dim=-1)
    hit = segments_in_collision(track, obstacles, offset_m=offset)
    spacing = (absolute[:, 1:] - absolute[:, :-1]).norm(dim=-1) / 199
    assert bool(hit[nearest < 0].all()), "a sampled state lies inside, the segment counts as free"
    assert not bool(hit[nearest > spacing].any()), "no state comes near, the segment counts as blocked"
    states = states_in_collision(track, obstacles, offset_m=offset)
    assert bool((states == (obstacles.signed_distance(absolute)[0] <= 0)).all())


def test_checker_is_fast():
    """1000 hypotheses × 96 steps × 20 obstacles: measured 0.02 s; the bound is for busy machines."""
    obstacles = some_obstacles(7, 10, 10)
    track = torch.cumsum(torch.randn(1000, 96, 2, generator=torch.Generator().manual_seed(0)), dim=1) + 50
    segments_in_collision(track[:2], obstacles)
    start = time.process_time()
    segments_in_collision(track, obstacles)
    assert time.process_time() - start < 1.0
