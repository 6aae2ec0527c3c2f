"""Agents of whom bearings tell: one without any position, one between positions, silence, what is refused or untouched."""

import dataclasses

import numpy as np
import pytest
import torch

from cadence.bank.bank import Bank
from cadence.bank.components import constant_velocity
from cadence.bearings.estimator import MEASURED, WithBearings, steady
from cadence.constraints.agility import Agility
from cadence.constraints.obstacles import Obstacles
from cadence.evidence.estimator import FEW_FIT, WithEvidence
from cadence.evidence.footprints import DetectionCurve
from cadence.evidence.measurements import Measurements
from cadence.evidence.silence import Looks, Silence
from cadence.types import Context, Detections, WindowBatch

STEP_S, HISTORY, HORIZON = 10.0, 20, 4
DATUM_M, ELAPSED_S = np.array([5000.0, -2000.0]), 1000.0
BANK = dataclasses.replace(Bank(constant_velocity([0.03**2, 0.1**2])), speed_mps=3.0)


def windows(*evidence: object, is_seen: bool = True) -> WindowBatch:
    """T0 is seen at both ends of its way along y = 0 at 3 m/s, T1 never."""
    time_s = torch.tensor([[[-190.0, -10.0], [0.0, 0.0]]]).double()
    position_m = torch.stack([3.0 * time_s + 570.0, 0.0 * time_s], -1)
    seen = torch.tensor([[[is_seen, is_seen], [False, False]]])
    detections = Detections(time_s, position_m, 25.0 * torch.eye(2).double().expand(1, 2, 2, 2, 2), seen)
    context = Context(
        torch.from_numpy(DATUM_M)[None], torch.tensor([ELAPSED_S]), evidence=tuple(evidence), agent_ids=("T0", "T1")
    )
    grid = (torch.arange(HISTORY + HORIZON) - HISTORY + 1).double() * STEP_S
    return WindowBatch(grid, detections, torch.tensor([5]), HISTORY - 1, context)


def crossed(agent: str, at_m=(800.0, 900.0), sigma_rad: float = 0.01, num: int = 12, velocity_mps=(0.0, 3.0)) -> Measurements:
    """Bearings from two places, in turn, of a target that is at `at_m` at the origin."""
    time_s = np.linspace(-185.0, -15.0, num)
    place_m = np.array(at_m) + time_s[:, None] * np.array(velocity_mps)
    observer_m = np.where(np.arange(num)[:, None] % 2, [1500.0, 0.0], [0.0, -200.0])
    apart, nothing = place_m - observer_m, np.full(num, np.nan)
    bearing = np.arctan2(apart[:, 1], apart[:, 0])
    angles = (bearing, np.full(num, sigma_rad), nothing, nothing)
    unmeasured = (nothing, nothing, nothing, nothing)
    place = (time_s + ELAPSED_S, observer_m + DATUM_M, np.zeros((num, 2)), nothing)
    return Measurements(*place, *angles, *unmeasured, (agent,) * num)


def drawn(batch: WindowBatch, num: int = 40, reach_m: float | None = 3000.0):
    return WithBearings(WithEvidence(BANK), BANK, reach_m).sample(batch, num)


def test_who_has_no_position_is_drawn_from_bearings_and_goes_on_after_them():
    found = drawn(windows(crossed("T1")))
    track_m = found.position_m[0, :, 1]
    assert found.status == (("ok", MEASURED),) and track_m.isfinite().all()
    assert found.num_effective is not None and float(found.num_effective[0, 1]) > 20
    middle = track_m.mean(0)
    assert middle[HISTORY - 1].tolist() == pytest.approx([800.0, 900.0], abs=40.0)
    assert middle[5].tolist() == pytest.approx([800.0, 900.0 - 3.0 * 140.0], abs=40.0)
    assert middle[-1].tolist() == pytest.approx([800.0, 900.0 + 3.0 * 40.0], abs=60.0)
    assert float(track_m[:, -1].std(0).max()) > float(track_m[:, HISTORY - 1].std(0).max())
    assert torch.equal(track_m, drawn(windows(crossed("T1"))).position_m[0, :, 1])
    # the other one is as it was without
    plain = WithEvidence(BANK).sample(windows(), 40)
    assert torch.equal(found.position_m[0, :, 0], plain.position_m[0, :, 0])


def test_sharp_bearings_lead_between_positions():
    # half way it is 60 m beside the straight way
    halfway = crossed("T0", (570.0, 60.0), 0.003, velocity_mps=(3.0, 0.0))
    halfway = halfway[np.abs(halfway.time_s - ELAPSED_S + 100.0) < 16.0]
    found, weighed = drawn(windows(halfway)), WithEvidence(BANK).sample(windows(halfway), 40)
    assert weighed.num_effective is not None and float(weighed.num_effective[0, 0]) < 20
    assert found.status[0][0] == "ok" and found.num_effective is not None and float(found.num_effective[0, 0]) > 20
    at = HISTORY - 1 - 10
    assert found.position_m[0, :, 0, at].mean(0).tolist() == pytest.approx([270.0, 60.0], abs=10.0)
    assert found.position_m[0, :, 0, 0].mean(0).tolist() == pytest.approx([0.0, 0.0], abs=5.0)


def test_silence_weighs_what_bearings_leave_open():
    alone = crossed("T1")[np.arange(0, 12, 2)]  # from one place: near or far
    curve = DetectionCurve(np.array([0.0, 0.9, 1.0]), np.array([0.95, 0.95, 0.0]))
    there_m = torch.tensor([2300.0, 2600.0])
    looks = Looks(
        np.linspace(ELAPSED_S - 180.0, ELAPSED_S, 10), np.tile(DATUM_M + there_m.numpy(), (10, 1)), np.full(10, 2000.0),
        np.zeros(10), curve,
    )  # fmt: skip
    found = drawn(windows(alone)), drawn(windows(alone, Silence((looks,))))
    within = [float(((one.position_m[0, :, 1, HISTORY - 5] - there_m).norm(dim=-1) < 1700.0).double().mean()) for one in found]
    assert within[0] > 0.2 and within[1] < 0.05


def test_what_samples_do_not_reach_is_refused_and_nothing_else_touched():
    wild = crossed("T1")
    wild = dataclasses.replace(wild, bearing_rad=np.tile([0.0, 2.0, -2.0], 4), bearing_sigma_rad=np.full(12, 1e-4))
    found = drawn(windows(wild))
    assert found.status == (("ok", FEW_FIT),) and found.position_m[0, :, 1].isnan().all()
    for batch in (windows(), windows(crossed("T7")), dataclasses.replace(windows(crossed("T1")), context=None)):
        plain, other = WithEvidence(BANK).sample(batch, 10), drawn(batch, 10)
        assert torch.equal(plain.position_m[:, :, 0], other.position_m[:, :, 0]) and plain.status == other.status


def test_steady_models_only():
    bank = Bank()
    models, which, log_weight = steady(bank)
    assert not models.has_home.any() and (models.turn_rate == 0).all() and (models.relaxation_rate <= 0.1).all()
    assert torch.equal(models.diffusion, bank.models.diffusion[torch.from_numpy(which)])
    assert float(log_weight.exp().sum()) == pytest.approx(1.0)
    assert WithBearings(BANK, BANK).name == "bank"


def test_limits_leave_only_tracks_that_keep_them():
    """T1 goes north at 3 m/s: some of its tracks keep 3.5 m/s and a distance from a rock beside the way, none half a metre."""
    batch = windows(crossed("T1"))
    there = torch.tensor([[DATUM_M[0] + 830.0, DATUM_M[1] + 600.0, 20.0]], dtype=torch.float64)
    batch = dataclasses.replace(batch, context=dataclasses.replace(batch.context, obstacles=Obstacles(there)))
    bearings = WithBearings(WithEvidence(BANK), BANK, 3000.0, limits=Agility(longest_m=3.5 * STEP_S), margin_m=5.0)
    found = bearings.sample(batch, 40)
    track_m = found.position_m[0, :, 1]
    assert found.status[0][1] == MEASURED and track_m.isfinite().all()
    assert float(track_m.diff(dim=1).norm(dim=-1).max()) <= 3.5 * STEP_S * (1 + 1e-6)
    assert float((track_m - torch.tensor([830.0, 600.0])).norm(dim=-1).min()) >= 25.0
    free_m = drawn(batch).position_m[0, :, 1]
    assert float((free_m - torch.tensor([830.0, 600.0])).norm(dim=-1).min()) < 25.0
    slow = dataclasses.replace(bearings, limits=Agility(longest_m=0.5 * STEP_S)).sample(batch, 40)
    assert slow.status[0][1] == FEW_FIT and slow.position_m[0, :, 1].isnan().all()
