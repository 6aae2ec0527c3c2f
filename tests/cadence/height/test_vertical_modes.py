"""The modes of vertical motion: their closed forms against integrals, composition, and units."""

import dataclasses

import pytest
import torch

from cadence.height.modes import Modes, default_modes, steps


def mode(relaxation=0.0, diffusion=0.0, initial=1.0, walk=0.0, home=0.0, end=0.0):
    return Modes(
        *(torch.tensor([float(value)], dtype=torch.float64) for value in (relaxation, diffusion, initial, walk, home, end))
    )


def covariance(found):
    return torch.tensor([[float(found.noise_zz), float(found.noise_zv)], [float(found.noise_zv), float(found.noise_vv)]])


def test_a_constant_rate_is_that_of_the_book():
    found = steps(mode(diffusion=2.0), torch.tensor([3.0], dtype=torch.float64))
    assert (float(found.gain), float(found.keep)) == (3.0, 1.0)
    assert covariance(found).flatten().tolist() == pytest.approx([2 * 27 / 3, 2 * 9 / 2, 2 * 9 / 2, 2 * 3])


def test_level_flight_and_walk():
    found = steps(mode(walk=0.5), torch.tensor([4.0], dtype=torch.float64))
    assert covariance(found).flatten().tolist() == pytest.approx([2.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("relaxation", [1e-4, 0.019, 0.021, 0.7, 3.0])
@pytest.mark.parametrize("kind", ["diffusion", "home"])
def test_noise_is_the_integral_of_the_response(relaxation, kind):
    duration = 1.0 if relaxation < 3 else 2.0
    found = steps(mode(relaxation, **{kind: 1.3}), torch.tensor([duration], dtype=torch.float64))
    t = (torch.arange(200_000, dtype=torch.float64) + 0.5) * duration / 200_000
    keep = torch.exp(-relaxation * t)
    # what a kick at the time t before the end does to height and rate
    of_rate = (1.0 - keep) / relaxation, keep
    response = of_rate if kind == "diffusion" else (1.0 - relaxation * of_rate[0], -relaxation * of_rate[1])
    wanted = [[float((a * b).mean()) * duration * 1.3 for a in response] for b in response]
    torch.testing.assert_close(covariance(found), torch.tensor(wanted), rtol=1e-6, atol=1e-9)


def test_two_steps_are_one():
    modes, _ = default_modes()
    first, second, whole = (steps(modes, torch.tensor([d], dtype=torch.float64)) for d in (0.7, 1.9, 2.6))
    zv = first.noise_zv + second.gain * first.noise_vv
    torch.testing.assert_close(first.gain + second.gain * first.keep, whole.gain)
    torch.testing.assert_close(first.keep * second.keep, whole.keep)
    torch.testing.assert_close(
        first.noise_zz + second.gain * (first.noise_zv + zv) + second.noise_zz, whole.noise_zz, rtol=1e-7, atol=1e-9
    )
    torch.testing.assert_close(second.keep * zv + second.noise_zv, whole.noise_zv, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(second.keep**2 * first.noise_vv + second.noise_vv, whole.noise_vv, rtol=1e-7, atol=1e-9)


def test_units_change_nothing():
    modes, _ = default_modes()
    plain = steps(modes, torch.tensor([1.5], dtype=torch.float64))
    scaled = steps(modes.scaled(10.0, 3.0), torch.tensor([15.0], dtype=torch.float64))
    torch.testing.assert_close(scaled.noise_zz, plain.noise_zz * 30.0**2)
    torch.testing.assert_close(scaled.noise_vv, plain.noise_vv * 3.0**2)
    torch.testing.assert_close(scaled.gain, plain.gain * 10.0)


def test_shapes_are_checked():
    with pytest.raises(ValueError, match="must share one shape"):
        dataclasses.replace(mode(), walk=torch.zeros(2))
