"""What a network adds to the bank's tracks, as a smooth displacement: it may bend a track, but not shake it.

The network answers in units of the bank's sigma, which far from detections is tens of step lengths: a hundredth of it between
neighbouring steps, which the training loss hardly sees, is a jump that no target could make.
"""

from torch import Tensor

from cadence.constraints.smoothing import smoothed

_TRUST = 0.1
"""The network's answer at one step is believed to this many sigmas of the bank; its course over many steps is what counts."""


def smoothed_displacement(displacement_m: Tensor, sigma_m: Tensor, bend_m: Tensor) -> Tensor:
    """What the network moved each hypothesis by, without what shakes it.

    Args:
        displacement_m: [R, K, T, 2] as it is.
        sigma_m: [R, T] standard deviation of the bank; a misfit counts in tenths of it.
        bend_m: [R] how much the bank's own tracks bend: root mean square of their second differences in a coordinate.

    Returns:
        [R, K, T, 2]; zero stays zero, and so does what is linear in time.
    """
    return smoothed(displacement_m, _TRUST * sigma_m, bend_m)


def bend_of(sample_m: Tensor) -> Tensor:
    """How much tracks [R, K, T, 2] bend: root mean square of the second differences of a coordinate [R]."""
    return sample_m.double().diff(n=2, dim=2).square().mean(dim=(1, 2, 3)).sqrt()
