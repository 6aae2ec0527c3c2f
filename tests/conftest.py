"""What all tests share: one thread (results depend on the number of threads), repeatable property tests, optional data."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

# Busy machines are slow at times: no deadline for one example (pytest limits the test), and the same examples each time.
settings.register_profile("cadence", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("cadence")

LONGEST = (
    "test_kill", "test_infer", "test_remote", "test_page_script", "test_weighing", "test_train_general", "test_end_to_end",
    "test_python_page", "test_bad_input", "test_narco", "test_evaluate", "test_retrospect",
)  # fmt: skip

SHARED_DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The files that take longest come first, so that at the end no process waits for another that has just begun one."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of recorded logs beside the checkout; tests that ask for it are skipped where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("needs the recorded logs in ../shared/data")
    return SHARED_DATA


@pytest.fixture
def write_log(tmp_path: Path) -> Callable[..., Path]:
    """Writes bytes to a file of the test's own, `log.mcap` unless named otherwise, and returns its path."""

    def write(data: bytes, name: str = "log.mcap") -> Path:
        path = tmp_path / name
        path.write_bytes(data)
        return path

    return write


@pytest.fixture
def few_map_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """MapScores of 40 moments, not of 1 200, for tests of other scores: they take most of the evaluation of a small mission."""
    monkeypatch.setattr("pipeline.evaluate.maps._MOST_CELLS", 40)
