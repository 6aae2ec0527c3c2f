"""Worlds: obstacles are never crossed, laws give their hand-computed values, the same generator gives the same episode."""

import math

import numpy as np
import pytest
import shapely

from cadence.worlds.episode import Episode, gaps_s
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from cadence.worlds.route import Agility, Craft, RouteField, RouteGrid, keep_out_for, smooth_path
from cadence.worlds.sensors import (
    Sortie,
    draw_noise,
    measurement_covariance,
    square_search,
    sweep_track,
    swerling_probability,
)
from cadence.worlds.terrain import Clearance, Terrain, blocks_segment, random_archipelago, smooth_field

NO_CIRCLES = np.zeros((0, 3))


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    config = PatrolConfig(num_agents=2)
    return [simulate_patrol(config, np.random.default_rng([11, seed])) for seed in range(5)]


def wall(gap_y: float) -> Terrain:
    """A wall along x = 0 in a map of 20 km with one gap of 3 km around `gap_y`."""
    lower = np.array([[-300.0, -10000.0], [300.0, -10000.0], [300.0, gap_y - 1500.0], [-300.0, gap_y - 1500.0]])
    upper = np.array([[-300.0, gap_y + 1500.0], [300.0, gap_y + 1500.0], [300.0, 10000.0], [-300.0, 10000.0]])
    return Terrain(20000.0, NO_CIRCLES, (lower, upper))


class TestTerrain:
    def test_clearance_is_never_further_above_the_truth_than_it_says(self) -> None:
        terrain = random_archipelago(np.random.default_rng(3), 30000.0)
        clearance = Clearance.of(terrain, 100.0)
        points = np.random.default_rng(4).uniform(-14999.0, 14999.0, (4000, 2))
        circles = [shapely.Point(x, y).buffer(r) for x, y, r in terrain.circles_m]
        land = shapely.union_all([*map(shapely.Polygon, terrain.polygons_m), *circles])
        truth = shapely.distance(shapely.points(points), land)
        raster = clearance.at_points(points)
        assert (raster - clearance.error_m <= truth).all()
        assert np.median(np.abs(raster - truth)) < 200.0  # a bound that is near, not just low
        assert raster[0] == clearance.at(*points[0])

    def test_outside_the_map_is_no_clearance(self) -> None:
        clearance = Clearance.of(Terrain(1000.0, NO_CIRCLES, ()), 100.0)
        assert clearance.at(600.0, 0.0) == 0.0
        assert clearance.at_points(np.array([[0.0, -501.0], [0.0, 0.0]])).tolist() == [0.0, 1000.0]

    def test_segments_touch_circles_and_polygons(self) -> None:
        terrain = Terrain(100.0, np.array([[0.0, 0.0, 5.0]]), (np.array([[20.0, 0.0], [30.0, 0.0], [30.0, 10.0]]),))
        start = np.array([[-10.0, 0.0], [-10.0, 5.5], [15.0, 1.0], [15.0, -1.0]])
        end = np.array([[10.0, 0.0], [10.0, 5.5], [40.0, 1.0], [40.0, -1.0]])
        assert blocks_segment(terrain.land(), start, end).tolist() == [True, False, True, False]

    def test_islands_keep_channels_between_them(self) -> None:
        terrain = random_archipelago(np.random.default_rng(8), 30000.0, channel_m=1500.0)
        shapes = [shapely.Polygon(polygon) for polygon in terrain.polygons_m]
        assert len(shapes) >= 8
        assert all(shape.is_valid for shape in shapes)
        distances = [a.distance(b) for i, a in enumerate(shapes) for b in shapes[:i]]
        assert min(distances) >= 1500.0

    def test_a_field_fills_zero_to_one_and_is_smooth(self) -> None:
        field = smooth_field(np.random.default_rng(1), 64, 12.0)
        assert (field.min(), field.max()) == (0.0, 1.0)
        assert np.abs(np.diff(field, axis=0)).max() < 0.2

    @pytest.mark.parametrize("circles", [np.zeros(3), np.zeros((2, 2))])
    def test_wrong_shapes_are_refused(self, circles: np.ndarray) -> None:
        with pytest.raises(ValueError, match="circles_m"):
            Terrain(10.0, circles, ())


class TestRoute:
    def test_the_way_leads_through_the_gap(self) -> None:
        clearance = Clearance.of(wall(6000.0), 100.0)
        grid = RouteGrid.of(clearance, 250.0, 400.0)
        field = RouteField.to(grid, grid.graph(np.ones(grid.is_free.shape)), np.array([8000.0, -8000.0]))
        path = field.path_from(np.array([-8000.0, -8000.0]))
        crossing = path[np.argmin(np.abs(path[:, 0]))]
        assert abs(crossing[1] - 6000.0) < 1500.0
        assert np.hypot(*(path[-1] - [8000.0, -8000.0])) <= 250.0

    def test_dear_cells_are_avoided(self) -> None:
        terrain = Terrain(20000.0, NO_CIRCLES, ())
        grid = RouteGrid.of(Clearance.of(terrain, 100.0), 250.0, 400.0)
        cost = np.where(np.abs(grid.centres_m[..., 1]) < 2000.0, 20.0, 1.0)
        cost[:, grid.centres_m[0, :, 0] > 6000.0] = 1.0
        field = RouteField.to(grid, grid.graph(cost), np.array([0.0, 8000.0]))
        path = field.path_from(np.array([0.0, -8000.0]))
        assert path[np.abs(path[:, 1]) < 1800.0, 0].min() > 5700.0

    def test_open_water_gives_the_octile_length(self) -> None:
        grid = RouteGrid.of(Clearance.of(Terrain(10000.0, NO_CIRCLES, ()), 100.0), 250.0, 0.0)
        field = RouteField.to(grid, grid.graph(np.ones(grid.is_free.shape)), np.array([3125.0, 1125.0]))
        path = field.path_from(np.array([-3875.0, -1875.0]))
        assert np.hypot(*np.diff(path, axis=0).T).sum() == pytest.approx(3000.0 * math.sqrt(2) + 4000.0)

    def test_smoothing_keeps_ends_and_clearance(self) -> None:
        clearance = Clearance.of(wall(0.0), 100.0)
        grid = RouteGrid.of(clearance, 250.0, 500.0)
        field = RouteField.to(grid, grid.graph(np.ones(grid.is_free.shape)), np.array([5000.0, -8000.0]))
        path = field.path_from(np.array([-5000.0, -8000.0]))
        smooth = smooth_path(path, clearance, 400.0)
        assert (smooth[[0, -1]] == path[[0, -1]]).all()
        assert clearance.at_points(smooth).min() >= 400.0

        def bending(track: np.ndarray) -> float:
            bearing = np.unwrap(np.arctan2(*np.diff(track, axis=0).T[::-1]))
            return float((np.diff(bearing) ** 2).sum())

        assert bending(smooth) < 0.5 * bending(path)

    def test_a_craft_keeps_its_agility_in_open_water(self) -> None:
        agility = Agility(max_speed_mps=10.0, max_accel_mps2=0.2, max_turn_degps=2.0)
        clearance = Clearance.of(Terrain(20000.0, NO_CIRCLES, ()), 100.0)
        craft = Craft(agility, clearance, 300.0, 0.0, 0.0, 0.0)
        craft.take(np.array([[-5000.0, 100.0], [-5000.0, -5000.0]]))
        headings, speeds = [craft.heading_rad], [craft.speed_mps]
        for _ in range(120):
            craft.follow(99.0, 10.0)
            headings.append(craft.heading_rad)
            speeds.append(craft.speed_mps)
        turns = np.abs((np.diff(headings) + np.pi) % (2 * np.pi) - np.pi)
        assert turns.max() <= math.radians(20.0) + 1e-9
        assert max(speeds) == 10.0
        assert np.abs(np.diff(speeds)).max() <= 2.0 + 1e-9
        assert craft.has_arrived

    def test_a_craft_that_is_sent_into_a_wall_does_not_touch_it(self) -> None:
        terrain = Terrain(20000.0, NO_CIRCLES, (np.array([[-300.0, -1e4], [300.0, -1e4], [300.0, 1e4], [-300.0, 1e4]]),))
        clearance = Clearance.of(terrain, 100.0)
        keep_out = keep_out_for(clearance, 15.0, 10.0)
        craft = Craft(Agility(15.0, 1.0, 5.0), clearance, keep_out, -3000.0, -4000.0, 0.0, 15.0)
        track = [craft.position_m]
        for _ in range(200):
            craft.take(np.array([[5000.0, -4000.0]]))
            craft.follow(15.0, 10.0)
            track.append(craft.position_m)
        assert not blocks_segment(terrain.land(), np.array(track[:-1]), np.array(track[1:])).any()
        assert max(x for x, _ in track) < -300.0

    def test_a_map_without_water_is_refused(self) -> None:
        terrain = Terrain(1000.0, np.array([[0.0, 0.0, 900.0]]), ())
        with pytest.raises(ValueError, match="no navigable water"):
            RouteGrid.of(Clearance.of(terrain, 50.0), 100.0, 10.0)


class TestSensors:
    def test_swerling_law(self) -> None:
        probability = swerling_probability(np.array([0.0, 500.0, 1000.0, 2400.0, 2600.0]), np.array(1000.0))
        assert probability[2] == pytest.approx(0.5)
        assert probability[0] > 0.99
        assert 0.0 < probability[3] < 0.01
        assert probability[4] == 0.0

    def test_covariance_lies_along_and_across_the_line_of_sight(self) -> None:
        sigma, bearing = np.array([20.0, 20.0, 20.0]), np.array([0.01, 0.01, 0.01])
        east, north, near = measurement_covariance(np.array([[3000.0, 0.0], [0.0, 500.0], [0.0, 0.0]]), sigma, bearing)
        np.testing.assert_allclose(east, [[400.0, 0.0], [0.0, 900.0]])
        np.testing.assert_allclose(north, [[25.0, 0.0], [0.0, 400.0]])
        np.testing.assert_allclose(near, 400.0 * np.eye(2))

    def test_noise_has_the_covariance(self) -> None:
        wanted = np.array([[400.0, 150.0], [150.0, 900.0]])
        noise = draw_noise(np.broadcast_to(wanted, (40000, 2, 2)), np.random.default_rng(0))
        np.testing.assert_allclose(np.cov(noise.T), wanted, rtol=0.06)

    def test_an_aircraft_keeps_to_its_speed_and_its_map(self) -> None:
        time_s = np.arange(0.0, 20000.0, 10.0)
        sortie = Sortie()
        track, is_flying = sweep_track(np.random.default_rng(5), time_s, 30000.0, sortie)
        speed = np.hypot(*np.diff(track, axis=0).T) / 10.0
        assert speed.max() <= sortie.speed_mps * (1 + 1e-9)
        assert np.abs(track).max() <= 15000.0
        assert 0.4 < is_flying.mean() < 0.95
        assert speed[~is_flying[:-1] & ~is_flying[1:]].max() == 0.0  # on the ground

    def test_square_search_expands(self) -> None:
        corners = square_search(np.zeros(2), 100.0, 5)
        assert corners.tolist() == [[0, 0], [100, 0], [100, 100], [-100, 100], [-100, -100], [200, -100]]


class TestPatrol:
    def test_no_segment_touches_land(self, episodes: list[Episode]) -> None:
        for episode in episodes:
            land, boats = episode.terrain.land(), [name.startswith("boat") for name in episode.sensor_ids]
            for tracks in (episode.truth_m, episode.sensors_m[boats]):
                assert not blocks_segment(land, tracks[:, :-1], tracks[:, 1:]).any()
            assert np.abs(episode.truth_m).max() < episode.terrain.side_m / 2

    def test_tracks_are_continuous_and_go_somewhere(self, episodes: list[Episode]) -> None:
        for episode in episodes:
            step = np.hypot(*np.moveaxis(np.diff(episode.truth_m, axis=1), -1, 0))
            assert step.max() <= 160.0 + 1e-6
            assert step.sum(axis=1).min() > 15000.0
            assert np.hypot(*np.ptp(episode.truth_m, axis=1).T).min() > 5000.0

    def test_modes_other_than_transit_occur(self, episodes: list[Episode]) -> None:
        counts = sum(np.bincount(episode.mode.ravel(), minlength=5) for episode in episodes)
        assert (counts > 0).all()
        assert counts[0] > 0.4 * counts.sum()

    def test_sensors_at_sea_level_do_not_see_through_land(self, episodes: list[Episode]) -> None:
        for episode in episodes:
            seen, land = episode.detections, episode.terrain.land()
            low = np.array([not episode.sensor_ids[sensor].startswith("aircraft") for sensor in seen.sensor])
            sensors, targets = episode.sensors_m[seen.sensor, seen.step], episode.truth_m[seen.agent, seen.step]
            assert not blocks_segment(land, sensors[low], targets[low]).any()

    def test_without_line_of_sight_they_do(self) -> None:
        config = PatrolConfig(line_of_sight=False, num_aircraft=0, detection_rate=0.3, duration_s=3600.0)
        blocked = 0
        for seed in range(3):
            episode = simulate_patrol(config, np.random.default_rng(seed))
            seen = episode.detections
            sensors, targets = episode.sensors_m[seen.sensor, seen.step], episode.truth_m[seen.agent, seen.step]
            blocked += blocks_segment(episode.terrain.land(), sensors, targets).sum()
        assert blocked > 0

    def test_errors_fit_their_covariance(self, episodes: list[Episode]) -> None:
        distances = []
        for episode in episodes:
            seen = episode.detections
            error = seen.position_m - episode.truth_m[seen.agent, seen.step]
            distances.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(seen.covariance_m2), error))
        distance = np.concatenate(distances)
        assert len(distance) > 300
        assert distance.mean() == pytest.approx(2.0, abs=5 * 2.0 / math.sqrt(len(distance)))

    def test_detections_are_rare_and_come_in_bursts(self, episodes: list[Episode]) -> None:
        is_detected = np.concatenate([episode.is_detected() for episode in episodes])
        rate = is_detected.mean()
        assert 0.06 < rate < 0.15
        assert is_detected[:, 1:][is_detected[:, :-1]].mean() > 3 * rate  # far likelier just after another one
        assert max(gaps_s(agent, 10.0).max() for agent in is_detected) > 600.0

    def test_detections_are_ordered_and_by_active_sensors(self, episodes: list[Episode]) -> None:
        for episode in episodes:
            seen = episode.detections
            assert episode.is_active[seen.sensor, seen.step].all()
            order = np.lexsort((seen.sensor, seen.agent, seen.step))
            assert (order == np.arange(len(seen))).all()

    def test_the_rate_is_what_is_asked_for(self) -> None:
        rates = []
        for rate in (0.05, 0.3):
            config = PatrolConfig(num_agents=3, detection_rate=rate, duration_s=3000.0)
            runs = [simulate_patrol(config, np.random.default_rng([5, seed])).is_detected().mean() for seed in range(5)]
            rates.append(np.mean(runs))
        assert 0.02 < rates[0] < 0.09
        assert 0.2 < rates[1] < 0.4

    def test_the_generator_decides_everything(self) -> None:
        config = PatrolConfig(duration_s=900.0)
        first, again, other = (simulate_patrol(config, np.random.default_rng(seed)) for seed in (3, 3, 4))
        assert (first.truth_m == again.truth_m).all()
        assert (first.detections.position_m == again.detections.position_m).all()
        assert not (first.truth_m == other.truth_m).all()

    @pytest.mark.parametrize("step_s", [1.0, 30.0])
    def test_other_steps_keep_clear_of_land_too(self, step_s: float) -> None:
        episode = simulate_patrol(PatrolConfig(duration_s=1800.0, step_s=step_s), np.random.default_rng(9))
        assert len(episode.time_s) == round(1800.0 / step_s) + 1
        assert not blocks_segment(episode.terrain.land(), episode.truth_m[:, :-1], episode.truth_m[:, 1:]).any()

    @pytest.mark.parametrize(
        ("name", "value"),
        [("num_agents", 0), ("step_s", 0.0), ("step_s", 60.0), ("duration_s", 5.0), ("detection_rate", 0.9), ("side_m", 1e3)],
    )
    def test_impossible_settings_are_refused(self, name: str, value: float) -> None:
        with pytest.raises(ValueError, match=name):
            PatrolConfig(**{name: value})

    def test_a_world_without_sensors_is_refused(self) -> None:
        with pytest.raises(ValueError, match="at least one"):
            PatrolConfig(num_boats=0, num_aircraft=0, num_masts=0)


def test_gaps_are_between_detections_only() -> None:
    assert gaps_s(np.array([0, 1, 1, 0, 0, 1, 0], dtype=bool), 10.0).tolist() == [30.0]
