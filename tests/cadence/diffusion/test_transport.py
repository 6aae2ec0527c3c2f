"""What the network adds, smoothed: identities of the Whittaker smoother, and that it does not depend on units."""

import torch

from cadence.diffusion.transport import bend_of, smoothed_displacement

STEPS = 40
SIGMA = torch.full((2, STEPS), 50.0, dtype=torch.float64)
BEND = torch.tensor([2.0, 2.0], dtype=torch.float64)


def noise(seed: int = 0) -> torch.Tensor:
    return torch.randn(2, 5, STEPS, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_nothing_stays_nothing_and_what_is_straight_stays_as_it_is() -> None:
    assert torch.equal(smoothed_displacement(torch.zeros(2, 5, STEPS, 2), SIGMA, BEND), torch.zeros(2, 5, STEPS, 2).double())
    line = (3.0 + 0.7 * torch.arange(STEPS).double())[:, None].expand(2, 5, STEPS, 2)
    torch.testing.assert_close(smoothed_displacement(line, SIGMA, BEND), line)


def test_jitter_goes_and_a_slow_bend_stays() -> None:
    bend = 30.0 * torch.sin(torch.arange(STEPS).double() / 10.0)[:, None].expand(2, 5, STEPS, 2)
    found = smoothed_displacement(bend + 5.0 * noise(), SIGMA, BEND)
    assert (found - bend).square().mean().sqrt() < 2.5
    assert found.diff(n=2, dim=2).abs().mean() < 0.05 * (bend + 5.0 * noise()).diff(n=2, dim=2).abs().mean()


def test_it_solves_the_normal_equations() -> None:
    """Least squares written plainly: rows of misfits and of second differences, each over its unit."""
    sigma = SIGMA * torch.rand(2, STEPS, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    given = 20.0 * noise(2)
    second = torch.eye(STEPS, dtype=torch.float64).diff(n=2, dim=0)
    for row in range(2):
        weight = 1.0 / (0.1 * sigma[row])
        system = torch.cat([torch.diag(weight), second / BEND[row]])
        right = torch.cat([weight[:, None] * given[row, 0], torch.zeros(STEPS - 2, 2, dtype=torch.float64)])
        expected = torch.linalg.lstsq(system, right).solution
        torch.testing.assert_close(smoothed_displacement(given, sigma, BEND)[row, 0], expected, atol=1e-6, rtol=1e-6)


def test_certain_steps_are_not_moved_and_units_do_not_matter() -> None:
    sigma = SIGMA.clone()
    sigma[:, 10] = 0.0
    given = 20.0 * noise(3)
    given[:, :, 10] = 0.0
    found = smoothed_displacement(given, sigma, BEND)
    assert found[:, :, 10].abs().max() < 1e-5
    torch.testing.assert_close(smoothed_displacement(1e3 * given, 1e3 * sigma, 1e3 * BEND), 1e3 * found, rtol=1e-6, atol=1e-3)


def test_how_much_tracks_bend() -> None:
    circle = torch.arange(STEPS).double()
    track = torch.stack([circle**2, 3.0 * circle], dim=-1).expand(2, 4, STEPS, 2)
    torch.testing.assert_close(bend_of(track), torch.full((2,), 2.0**0.5, dtype=torch.float64))
