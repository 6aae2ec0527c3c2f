"""Parts of the report by hand-computed cases and identities."""

import json
import tomllib
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from fixtures.mission import build_mission
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.clock import Clock, duration
from pipeline.config import read_config
from pipeline.frames import to_geodetic
from pipeline.lengths import metres, nice_length
from pipeline.report.analysis import analyse, choose_moments, find_troubles
from pipeline.report.charts import SpreadAxis
from pipeline.report.fans import Detail, choose_detail, choose_vertices, encode_fan
from pipeline.report.geodesy import EXPONENTS, fit_geodesy
from pipeline.report.maps import moment_map
from pipeline.report.markup import as_toml, inline_json, text
from pipeline.report.mission import Fan, Points, load_mission
from pipeline.report.modes import strands_of
from pipeline.report.shapes import shape_of, spread_at
from pipeline.tables import Frame

SECOND = 1_000_000_000


def fan_of(
    offset_m: np.ndarray, weight: np.ndarray | None = None, origin_index: int = 0, datum_m: tuple[float, float] = (0, 0)
) -> Fan:
    share = np.full(len(offset_m), 1 / len(offset_m)) if weight is None else weight
    return Fan(0, 0, 100 * SECOND, SECOND, origin_index, share, np.array(datum_m, float), offset_m.astype(np.float32))


def inside(fan: Fan, position_m: np.ndarray, level: int) -> np.ndarray:
    """Whether positions [K, T, 2] relative to the datum lie in the envelope of a level, from the drawn numbers only."""
    shape = shape_of(fan)
    away = position_m + fan.datum_m - shape.mean_m
    cos, sin = np.cos(shape.angle_rad), np.sin(shape.angle_rad)
    along, across = away[..., 0] * cos + away[..., 1] * sin, away[..., 1] * cos - away[..., 0] * sin
    axes = np.sqrt(shape.axes_m**2 + 1e-6)
    return np.hypot(along / axes[:, 0], across / axes[:, 1]) <= shape.radius[level] * (1 + 1e-6)


def test_shape_of_four_points_on_a_cross() -> None:
    fan = fan_of(np.array([[[3.0, 4]], [[-3, -4]], [[-0.8, 0.6]], [[0.8, -0.6]]]), datum_m=(10, 20))
    shape = shape_of(fan)
    assert shape.mean_m[0] == pytest.approx([10, 20])
    # Variance 2 · 25 / 4 along (3, 4) / 5 and 2 · 1 / 4 across it.
    assert shape.axes_m[0] == pytest.approx([np.sqrt(12.5), np.sqrt(0.5)], rel=1e-6)
    assert np.tan(shape.angle_rad[0]) == pytest.approx(4 / 3, rel=1e-5)
    assert shape.spread_m[0] == pytest.approx(np.sqrt(13), rel=1e-6)
    assert shape.radius[:, 0] == pytest.approx([np.sqrt(2), np.sqrt(2)], rel=1e-4)


def test_weights_move_mean_and_envelopes() -> None:
    fan = fan_of(np.array([[[0.0, 0]], [[10, 0]], [[0, 10]]]), np.array([0.95, 0.04, 0.01]))
    shape = shape_of(fan)
    assert shape.mean_m[0] == pytest.approx([0.4, 0.1])
    held = inside(fan, fan.offset_m.astype(float), 1)[:, 0]
    assert held.tolist() == [True, False, False]


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 40), st.integers(0, 10_000))
def test_envelopes_hold_their_share_of_the_weight(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    fan = fan_of(rng.normal(0, 50, (count, 3, 2)), rng.dirichlet(np.ones(count)))
    for level, share in enumerate((0.5, 0.9)):
        held = (inside(fan, fan.offset_m.astype(float), level) * fan.weight[:, None]).sum(axis=0)
        assert (held >= share - 1e-6).all()


def test_hypotheses_in_one_point_have_an_envelope_of_one_point() -> None:
    shape = shape_of(fan_of(np.full((5, 2, 2), 7.0)))
    assert np.isfinite(shape.radius).all() and (shape.axes_m * shape.radius[1][:, None] < 1e-9).all()


def test_spread_at_some_steps_is_that_of_the_shape() -> None:
    fan = fan_of(np.random.default_rng(1).normal(0, 50, (9, 5, 2)), np.random.default_rng(2).dirichlet(np.ones(9)))
    assert spread_at(fan, [0, -1]) == pytest.approx(shape_of(fan).spread_m[[0, -1]], rel=1e-6)


def test_moments_are_few_ordered_and_named(tmp_path) -> None:
    mission = load_mission(build_mission(tmp_path))
    analysis = analyse(mission, "", lambda _: None)
    moments = choose_moments(mission, analysis, 4)
    origins = [mission.fans[moment.fan].origin_ns for moment in moments]
    assert len(moments) == 4 and origins == sorted(origins)
    widest = next(moment for moment in moments if "idest at its moment" in moment.reason)
    assert analysis.spread_now_m[widest.fan] == analysis.spread_now_m.max()
    assert choose_moments(mission, analysis, 0) == ()


def test_troubles_are_runs_of_neighbours(tmp_path) -> None:
    mission = load_mission(build_mission(tmp_path))
    (trouble,) = find_troubles(mission)
    assert (trouble.agent, trouble.status, trouble.count, trouble.first.window) == (1, "no_detections", 1, 5)
    rows = [
        row.__class__(**{**row.__dict__, "status": "x" if row.agent == 0 and row.window in (0, 1, 3) else "ok"})
        for row in mission.rows
    ]
    runs = find_troubles(mission.__class__(**{**mission.__dict__, "rows": tuple(rows)}))
    assert [(run.first.window, run.last.window, run.count) for run in runs] == [(0, 1, 2), (3, 3, 1)]


def test_vertices_follow_a_corner_exactly() -> None:
    corner = np.concatenate([np.stack([np.arange(10), np.zeros(10)], 1), np.stack([np.full(9, 9), np.arange(1, 10)], 1)])
    chosen = choose_vertices(corner[None].astype(float), [4], 4)
    assert chosen.tolist() == [0, 4, 9, 18]
    assert choose_vertices(corner[None].astype(float), [4], 40).tolist() == list(range(19))
    assert len(set(choose_vertices(np.zeros((1, 19, 2)), [18], 5).tolist())) == 5


def test_encoding_survives_one_wild_hypothesis() -> None:
    track = np.zeros((2, 5, 2))
    track[1] = 1e6
    fan = fan_of(track)
    code = encode_fan(fan, strands_of(fan, shape_of(fan), None), Detail(1, 1, 2, 5))
    assert np.abs(code.hypothesis * code.scale_m + code.centre_m - track).max() <= code.scale_m
    assert (np.abs(code.summary.astype(int)) <= 32_000).all()


def test_detail_fits_the_budget_and_sheds_agents_last(tmp_path) -> None:
    mission = load_mission(build_mission(tmp_path))
    wanted = Detail(6, 2, 30, 96)
    assert choose_detail(mission, 1e9, wanted) == wanted
    for budget in (2e5, 5e4, 1.5e4):
        detail = choose_detail(mission, budget, wanted)
        assert detail.num_bytes(11 / 12) <= budget
    assert choose_detail(mission, 5e4, wanted).num_agents == 2


@pytest.mark.parametrize("longitude_deg", [-1.2, 179.99])
def test_geodesy_fit_agrees_with_the_projection(longitude_deg: float) -> None:
    frame = Frame("mission", 50.8, longitude_deg)
    fit = fit_geodesy(frame, np.array([-40_000.0, -10_000]), np.array([60_000.0, 30_000]))
    x_m, y_m = np.array([-40_000.0, 0, 12_345, 60_000]), np.array([-10_000.0, 0, -678, 30_000])
    u, v = (x_m - fit.centre_m[0]) / fit.half_m, (y_m - fit.centre_m[1]) / fit.half_m
    latitude, longitude = (
        sum(c * u**i * v**j for c, (i, j) in zip(side, EXPONENTS, strict=True)) for side in (fit.latitude, fit.longitude)
    )
    real_latitude, real_longitude = to_geodetic(frame, x_m, y_m)
    assert np.abs(latitude - real_latitude).max() < 1e-5
    assert np.abs((longitude - real_longitude + 180) % 360 - 180).max() < 1e-5


def test_no_geodesy_without_datum_or_across_a_hemisphere() -> None:
    corner = np.array([1e7, 1e7])
    assert fit_geodesy(Frame("map"), -corner, corner) is None
    assert fit_geodesy(Frame("mission", 50.8, -1.2), -corner, corner) is None


def test_times_and_lengths_for_people() -> None:
    calendar = Clock(1_700_000_000 * SECOND, 1_700_000_200 * SECOND)
    assert calendar.moment(1_700_000_001_500_000_000, 1) == "22:13:21.5"
    assert calendar.range() == "2023-11-14 22:13:20 to 22:16:40 UTC"
    assert [label for _, label in calendar.ticks(calendar.start_ns, calendar.end_ns, 4)] == ["22:14:00", "22:15:00", "22:16:00"]
    assert Clock(1_700_000_000 * SECOND, 1_700_090_000 * SECOND).moment(1_700_000_001 * SECOND) == "14 Nov 22:13:21"
    since = Clock(5 * SECOND, 70 * SECOND)
    assert since.moment(3_725 * SECOND) == "T+01:02:00" and since.moment(4 * SECOND) == "T-00:00:01"
    assert since.ticks(5 * SECOND, 70 * SECOND, 4)[1] == (35 * SECOND, "T+00:00:30")
    seconds = [0.5, 12.345, 59.7, 60, 198, 7500, 86_400, 277_200]
    assert [duration(s) for s in seconds] == [
        "0.5 s",
        "12.3 s",
        "1 min",
        "1 min",
        "3 min 18 s",
        "2 h 05 min",
        "1 d",
        "3 d 05 h",
    ]
    assert [metres(x) for x in (0.00123, 0.01234, 12.34, 999.4, 999.6, 12_345, 1_234_567)] == [
        "under 1 cm",
        "0.0123 m",
        "12.3 m",
        "999 m",
        "1 km",
        "12.3 km",
        "1,235 km",
    ]
    assert [nice_length(x) for x in (0.3, 1, 4.99, 5, 99)] == [0.2, 1, 2, 5, 50]


def test_inline_json_cannot_end_its_element() -> None:
    value = ["</script><!--", "&lt;", "\u2028", "\ud800"]
    dense = inline_json(value)
    assert not set("<>&\u2028") & set(dense) and json.loads(dense) == value
    with pytest.raises(ValueError):
        inline_json(float("nan"))


def test_long_values_are_cut_and_say_so() -> None:
    assert text("<" * 1000).endswith("… (1,000 characters)")
    assert (text(None), text(True), text(1.0), text({"b": 1})) == ("none", "yes", "1", "{&quot;b&quot;: 1}")


def test_settings_come_back_from_their_toml() -> None:
    @dataclass(frozen=True)
    class Inner:
        topic: str
        sigma_m: float | None = None

    @dataclass(frozen=True)
    class Outer:
        name: str = "x"
        entries: tuple[Inner, ...] = field(default_factory=tuple)
        rate: float = 1.0
        is_on: bool = True
        limit: int | None = 3

    entries = [{"topic": "/c/{agent}", "sigma_m": 1e-07}, {"topic": "/d", "sigma_m": None}]
    config = {"name": 'a "b" \\ \n\x7fé', "entries": entries, "rate": float("inf"), "is_on": False, "limit": None}
    back = tomllib.loads(as_toml({"extract": config}))["extract"]
    # Unset keys are left out, and take their default when read back.
    assert read_config(Outer, back) == Outer(config["name"], (Inner("/c/{agent}", 1e-07), Inner("/d")), float("inf"), False, 3)


def test_spread_axis_puts_decades_on_a_line() -> None:
    class Spreads:
        spread_now_m = np.array([1.5, 20.0])
        spread_end_m = np.array([80.0, np.nan])

    axis = SpreadAxis(Spreads())
    assert axis.decades() == [1.0, 10.0, 100.0]
    assert axis.pixels(np.array([100.0, 10, 1, 0])).tolist() == pytest.approx([0, 42, 84, 84])


def test_a_detection_far_from_all_hypotheses_does_not_shrink_a_map(tmp_path) -> None:
    mission = load_mission(build_mission(tmp_path))
    fan = mission.fans[0]
    strands = strands_of(fan, shape_of(fan), None)
    steps = (0, fan.offset_m.shape[1] - 1)
    near = moment_map(mission, fan, strands, None, steps, "")
    far = Points(np.array([fan.origin_ns]), np.array([fan.agent]), np.array([[9e6, 9e6]]))
    seen = mission.detections
    more = Points(*(np.concatenate([getattr(seen, name), getattr(far, name)]) for name in ("time_ns", "owner", "position_m")))
    order = np.argsort(more.time_ns, kind="stable")
    more = Points(more.time_ns[order], more.owner[order], more.position_m[order])
    odd = moment_map(replace(mission, detections=more), fan, strands, None, steps, "")
    assert odd.partition('class="bar"')[2] == near.partition('class="bar"')[2]
