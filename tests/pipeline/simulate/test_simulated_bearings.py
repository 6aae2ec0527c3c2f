"""Logs with direction finders and polar detections: read without settings, and the same bytes as before without them."""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from cadence.worlds.sensors import Listening
from pipeline.config import config_as_dict
from pipeline.extract.config import ExtractConfig
from pipeline.extract.writing import write_tables
from pipeline.logs.reader import open_log
from pipeline.progress import Progress
from pipeline.provenance import versions
from pipeline.simulate.stage import VERSION, SimulateConfig, _key, simulate
from pipeline.tables import read_table

QUIET = Progress(quiet=True)
PATROL = PatrolConfig(duration_s=900.0, detection_rate=0.3)
HEARD = dataclasses.replace(PATROL, listening=Listening("both", radio_rate=0.3, sigma_deg=0.1))


def extracted(folder: Path, config: SimulateConfig) -> tuple[Path, dict]:
    (path,) = simulate(folder / "logs", config, QUIET).outputs
    out = folder / "out"
    out.mkdir()
    return out, write_tables(open_log(path), out, ExtractConfig(), QUIET)


@pytest.mark.parametrize("is_georeferenced", [False, True])
def test_bearings_point_at_who_was_heard(tmp_path: Path, is_georeferenced: bool) -> None:
    out, summary = extracted(tmp_path, SimulateConfig(seed=6, georeferenced=is_georeferenced, patrol=HEARD))
    bearings = simulate_patrol(HEARD, np.random.default_rng([6, 0])).bearings
    assert bearings is not None and summary["measurements"]["num"] == len(bearings) > 0 and summary["suspicions"] == []
    table, truth = read_table(out / "measurements.parquet", "measurements")[0], read_table(out / "truth.parquet", "truth")[0]
    at = np.searchsorted(truth["time_ns"].to_numpy(), table["time_ns"].to_numpy())
    east = truth["x_m"].to_numpy()[at] - table["observer_x_m"].to_numpy()
    north = truth["y_m"].to_numpy()[at] - table["observer_y_m"].to_numpy()
    error = np.degrees(np.angle(np.exp(1j * (table["bearing_rad"].to_numpy() - np.arctan2(north, east)))))
    # on the globe north turns by .2 degrees over the map
    assert np.abs(error).max() < (0.6 if is_georeferenced else 0.4)
    is_boat = np.array([name.startswith("boat") for name in table["sensor_id"].to_pylist()])
    speed = np.hypot(table["observer_vx_mps"].to_numpy(), table["observer_vy_mps"].to_numpy())
    assert (speed[~is_boat] == 0).all() and speed[is_boat].max() > 3.0


def test_ranges_and_bearings_are_the_same_detections(tmp_path: Path) -> None:
    polar, summary = extracted(tmp_path, SimulateConfig(seed=6, patrol=PATROL, is_polar=True))
    (tmp_path / "plain").mkdir()
    plain, _ = extracted(tmp_path / "plain", SimulateConfig(seed=6, patrol=PATROL))
    found, given = (read_table(folder / "detections.parquet", "detections")[0] for folder in (polar, plain))
    assert len(found) == len(given) and summary["suspicions"] == []
    for name in ("x_m", "y_m"):
        np.testing.assert_allclose(found[name].to_numpy(), given[name].to_numpy(), rtol=2e-3, atol=3.0)
    for name in ("cov_xx_m2", "cov_yy_m2"):
        np.testing.assert_allclose(found[name].to_numpy(), given[name].to_numpy(), rtol=0.1, atol=20.0)


def test_without_them_logs_are_as_they_were() -> None:
    """What a log says of the settings that made it does not name what is off: it would be written anew, in other bytes."""
    plain, off = SimulateConfig(patrol=PATROL), SimulateConfig(patrol=dataclasses.replace(PATROL, listening=Listening()))
    settled = {name: value for name, value in config_as_dict(plain.patrol).items() if name != "listening"}
    known = {**config_as_dict(dataclasses.replace(plain, num_episodes=1, first_index=0)), "patrol": settled}
    kept = {n: v for n, v in known.items() if n != "is_polar" and (n == "patrol" or not isinstance(v, dict))}
    made_by = {name: versions()[name] for name in ("cadence", "numpy", "mcap")}
    text = json.dumps({"config": kept, "version": VERSION, "made_by": made_by}, sort_keys=True)
    assert _key(plain, 0) == _key(off, 0) == hashlib.sha256(text.encode()).hexdigest()
    assert (
        len({_key(config, 0) for config in (plain, SimulateConfig(patrol=HEARD), SimulateConfig(patrol=PATROL, is_polar=True))})
        == 3
    )


def test_other_worlds_are_not_polar() -> None:
    with pytest.raises(ValueError, match="is_polar is of the world patrol"):
        SimulateConfig(world="prison", is_polar=True)
