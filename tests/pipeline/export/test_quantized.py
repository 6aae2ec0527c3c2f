"""Tracks as whole numbers: as near as is said, and what protobuf reads."""

import numpy as np
import pytest
from fixtures.side_files import assert_near, dequantized

from pipeline.export.quantized import quantize
from schemas.channels import message_class


def tracks(num: int, num_axes: int, seed: int = 1) -> np.ndarray:
    """Bridges that fan out between sharp places, on a scale of kilometres."""
    rng = np.random.default_rng(seed)
    width = 0.01 + 800.0 * np.sin(np.linspace(0, 3 * np.pi, 60)) ** 2
    walk = np.cumsum(np.cumsum(rng.normal(size=(num, 60, num_axes)), axis=1), axis=1)
    return (5e4 + width[:, None] * walk / 300.0).astype(np.float32)


def read(data: bytes, num_axes: int) -> np.ndarray:
    return dequantized(message_class("cadence.Tracks").FromString(data), num_axes)


@pytest.mark.parametrize("num_axes", [1, 2])
def test_each_coordinate_is_within_a_hundredth_of_the_spread(num_axes):
    track, weight = tracks(30, num_axes), np.random.default_rng(2).random(30).astype(np.float32)
    found = quantize(track, weight)
    assert found is not None
    assert_near(read(found.encode(), num_axes), track, weight)
    assert len(found.encode()) < 0.5 * track.nbytes


def test_who_is_no_part_of_a_hypothesis_stays_so():
    track, weight = tracks(6, 2), np.ones(6, np.float32)
    track[[1, 4]] = np.nan
    found = quantize(track, weight)
    assert found is not None and found.absent.tolist() == [1, 4]
    assert_near(read(found.encode(), 2), track, weight)
    nobody = quantize(np.full_like(track, np.nan), weight)
    assert nobody is not None and np.isnan(read(nobody.encode(), 2)).all() and len(read(nobody.encode(), 2)) == 6


def test_tracks_with_gaps_are_left_to_floats():
    track = tracks(3, 2)
    track[1, 5] = np.nan
    assert quantize(track, np.ones(3, np.float32)) is None


@pytest.mark.parametrize("weight", [np.ones(1, np.float32), np.zeros(1, np.float32)])
def test_one_track_alone_keeps_all_its_digits(weight):
    track = tracks(1, 2)
    found = quantize(track, weight)
    assert found is not None
    assert np.abs(read(found.encode(), 2) - track).max() <= 4e-3, "a float32 at 50 km"


def test_the_bytes_are_those_of_protobuf():
    found = quantize(tracks(5, 2) * np.float32(1e-3), np.ones(5, np.float32))
    assert found is not None
    message = message_class("cadence.Tracks")(
        exponent=found.exponent.tolist(), residual=found.residual.reshape(-1).tolist(), absent=found.absent.tolist()
    )
    assert message.SerializeToString() == found.encode()
