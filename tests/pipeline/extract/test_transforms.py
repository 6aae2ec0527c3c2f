"""Transform trees: hand-computed poses, interpolation, limits, chains there and back, and trees that are none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from pipeline.extract.covariances import NONE_COVARIANCE, isotropic, rotated, stated_covariance
from pipeline.extract.transforms import Limits, Link, Motion, TransformTree, slerp, tree_of

LIMITS = Limits(max_extrapolation_s=0.5, max_gap_s=20.0)


def yaw(*degrees: float) -> np.ndarray:
    return (
        Rotation.from_rotvec([[0.0, 0.0, angle] for angle in degrees], degrees=True).as_quat() if degrees else np.zeros((0, 4))
    )


def link(
    parent: str, child: str, times_s: list[float], places: list[list[float]], turns: np.ndarray, static: bool = False
) -> Link:
    times = np.round(np.array(times_s) * 1e9).astype(np.int64)
    return Link(parent, child, times, np.array(places, dtype=float), turns, static)


def at(*times_s: float) -> np.ndarray:
    return np.round(np.array(times_s) * 1e9).astype(np.int64)


def moved(motion: Motion, position_m: np.ndarray) -> np.ndarray:
    """Positions [M, 3] of the inner frame in the outer one."""
    return np.einsum("nij,nj->ni", motion.rotation, position_m) + motion.translation_m


SHIP = link("map", "ship", [0, 10], [[0, 0, 0], [10, 0, 0]], yaw(0, 90))
RADAR = link("ship", "radar", [3], [[2, 0, 1]], yaw(180), static=True)
TREE = tree_of([SHIP, RADAR])


def test_a_radar_on_a_ship_that_turns() -> None:
    """At 5 s the ship is at x = 5, turned by 45°; the radar looks backwards from 2 m before its middle."""
    motion = TREE.motion("radar", "map", at(5.0, 0.0, 10.0), LIMITS)
    assert motion is not None and motion.is_known.all()
    half = np.sqrt(0.5)
    found = moved(motion, np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    np.testing.assert_allclose(found, [[5 + half, half, 1], [1, 0, 1], [11, 2, 1]], atol=1e-12)


def test_there_and_back_is_nothing() -> None:
    times = at(0.0, 3.3, 7.0)
    there, back = TREE.motion("radar", "map", times, LIMITS), TREE.motion("map", "radar", times, LIMITS)
    assert there is not None and back is not None
    both = back.after(there)
    np.testing.assert_allclose(both.rotation, np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(both.translation_m, 0.0, atol=1e-12)


def test_between_branches_the_way_goes_over_the_common_frame() -> None:
    camera = link("ship", "camera", [0], [[0, 4, 0]], yaw(0), static=True)
    motion = tree_of([SHIP, RADAR, camera]).motion("radar", "camera", at(6.0), LIMITS)
    assert motion is not None
    np.testing.assert_allclose(moved(motion, np.array([[1.0, 0.0, 0.0]])), [[1, -4, 1]], atol=1e-12)


def test_slerp_is_that_of_scipy() -> None:
    first, second = Rotation.random(50, rng=1), Rotation.random(50, rng=2)
    share = np.random.default_rng(0).uniform(size=50)
    mine = Rotation.from_quat(slerp(first.as_quat(), -second.as_quat(), share))
    for i in range(50):
        theirs = Slerp([0, 1], Rotation.concatenate([first[i], second[i]]))(share[i])
        assert (mine[i] * theirs.inv()).magnitude() < 1e-7


def test_what_is_far_from_its_samples_is_refused() -> None:
    ship = link("map", "ship", [0, 10, 40], [[0, 0, 0], [10, 0, 0], [40, 0, 0]], yaw(0, 0, 0))
    times = at(-0.6, -0.5, 0.0, 5.0, 10.4, 11.0, 39.6, 40.5, 40.6)
    motion = ship.motion(times, LIMITS)
    assert motion.is_known.tolist() == [False, True, True, True, True, False, True, True, False]
    np.testing.assert_allclose(motion.translation_m[motion.is_known, 0], [0, 0, 5, 10, 40, 40])


def test_static_links_always_hold() -> None:
    motion = RADAR.motion(at(-1e6, 1e6), LIMITS)
    assert motion.is_known.all() and motion.translation_m.tolist() == [[2, 0, 1]] * 2


def test_worlds_and_fixed_frames() -> None:
    earth = link("earth", "map", [0], [[6e6, 0, 0]], yaw(0), static=True)
    tree = tree_of([SHIP, RADAR, earth])
    assert (tree.world("radar"), tree.world("map"), tree.world("elsewhere")) == ("map", "map", "elsewhere")
    assert tree.is_fixed("map") and not tree.is_fixed("radar") and tree.is_fixed("elsewhere")


def test_frames_of_different_trees_have_no_way() -> None:
    other = link("odom", "cart", [0], [[0, 0, 0]], yaw(0))
    assert tree_of([SHIP, other]).motion("cart", "map", at(0.0), LIMITS) is None


def test_cycles_are_named_and_taken_out() -> None:
    def one(parent: str, child: str) -> Link:
        return link(parent, child, [0], [[1, 0, 0]], yaw(0), static=True)

    tree = tree_of([one("a", "b"), one("b", "c"), one("c", "a"), one("c", "d"), RADAR])
    assert tree.problems == ("frames a → c → b → a form a cycle and are not used",)
    assert set(tree.links) == {"d", "radar"} and tree.motion("d", "a", at(0.0), LIMITS) is None


def test_of_two_parents_the_one_with_more_samples_counts() -> None:
    tree = tree_of([SHIP, link("odom", "ship", [0], [[0, 0, 0]], yaw(0))])
    assert tree.links["ship"] is SHIP
    assert tree.problems == ("frame ship has the parents map and odom; map is used",)


def test_the_order_of_links_does_not_matter() -> None:
    links = [SHIP, RADAR, link("odom", "ship", [0], [[0, 0, 0]], yaw(0))]
    assert tree_of(links).links == tree_of(links[::-1]).links


def test_a_link_needs_samples_that_fit() -> None:
    with pytest.raises(ValueError, match="map → ship"):
        link("map", "ship", [], [], yaw())
    with pytest.raises(ValueError, match="do not fit"):
        link("map", "ship", [0, 1], [[0, 0, 0]], yaw(0))


def test_no_transforms() -> None:
    motion = TransformTree().motion("a", "a", at(0.0), LIMITS)
    assert motion is not None and moved(motion, np.array([[1.0, 2.0, 3.0]])).tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (4.0, (4, 0, 4, 0, 0, 4)),
        ([4.0, 1.0, 1.0, 9.0], (4, 1, 9, 0, 0, 6.5)),  # no height: the mean of the others
        ([4.0, 1.0, 0.5, 9.0, 0.25, 16.0], (4, 1, 9, 0.5, 0.25, 16)),
        ([4.0, 1, 0.5, 1, 9, 0.25, 0.5, 0.25, 16], (4, 1, 9, 0.5, 0.25, 16)),
        ([4.0, 1, 0, 1, 9, 0, 0, 0, 0], (4, 1, 9, 0, 0, 6.5)),
        ([4.0, 1, 99, 1, 9, 0, 99, 0, 16], (4, 1, 9, 0, 0, 16)),  # heights that are no part of a covariance
        ([0.0] * 9, None),
        ([-1.0] + [0.0] * 8, None),
        ([1e308, 0.0, 0.0, 1e308], None),  # what drivers write for "do not use"
        ([4.0, 0.0, 0.0, float("inf")], None),
        ([1e8, 0.0, 0.0, 1e8], None),
        ([float("nan")] * 4, None),
        ([1e7, 0.0, 0.0, 1e7], (1e7, 0, 1e7, 0, 0, 1e7)),
        ([4.0, 9.0, 16.0], (4, 0, 9, 0, 0, 16)),  # a diagonal
        ([4.0, 1, 0.5, 0, 0, 0, 9, 0.25, 0, 0, 0, 16, *[0] * 9], (4, 1, 9, 0.5, 0.25, 16)),  # an upper triangle of six
        ([1.0, 2.0], None),
    ],
)
def test_stated_covariances(matrix: object, expected: tuple[float, ...] | None) -> None:
    assert stated_covariance(matrix) == expected


@pytest.mark.parametrize("matrix", [[1.0, 5.0, 5.0, 1.0], [4.0, 0.0, 0.0, float("nan")], [4.0, 0.0, 0.0, 0.0]])
def test_what_is_no_covariance(matrix: list[float]) -> None:
    with pytest.raises(ValueError, match="positive definite"):
        stated_covariance(matrix)


def test_covariances_turn_with_their_frame() -> None:
    rotation = Rotation.from_euler("zyx", [[90, 0, 0], [0, 90, 0], [20, 30, 40]], degrees=True).as_matrix()
    full = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.25], [0.5, 0.25, 16.0]])
    found = rotated(np.array([[4.0, 1.0, 9.0, 0.5, 0.25, 16.0]] * 3), rotation)
    np.testing.assert_allclose(found[0], [9, -1, 4, -0.25, 0.5, 16], atol=1e-12)  # a quarter turn swaps x and y
    assert found[1, 0] == pytest.approx(16.0)  # looking down: what was height is x
    turned = rotation[2] @ full @ rotation[2].T
    np.testing.assert_allclose(found[2], turned[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]])
    np.testing.assert_allclose(rotated(np.array([isotropic(2.0)]), rotation[2:])[0], isotropic(2.0), atol=1e-12)
    assert np.isnan(rotated(np.array([NONE_COVARIANCE]), rotation[2:])).all()
