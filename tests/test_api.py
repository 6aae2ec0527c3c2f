"""The public interface, what `cadence` and `pipeline` export, is frozen: a change of it changes tests/api.txt as well.

Write it anew with: python tests/test_api.py
"""

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
FROZEN = Path(__file__).with_name("api.txt")
HEADER = "# Public names (docs/python.md): what the packages export in __init__.pyi, and how it is called.\n"
PACKAGES = ("cadence", "pipeline")


def public_names() -> list[str]:
    """`package.name(parameters)`; a class with the parameters of its constructor, and its methods and properties."""
    found = []
    for package in PACKAGES:
        module = importlib.import_module(package)
        for name in sorted(module.__all__):
            found += [f"{package}.{name}{line}" for line in described(getattr(module, name))]
    return found


def described(value: Any) -> list[str]:
    is_error = inspect.isclass(value) and issubclass(value, Exception)
    call = "" if is_error else f"({', '.join(inspect.signature(value).parameters)})"
    if not inspect.isclass(value):
        return [call]
    fields = getattr(value, "__dataclass_fields__", {})
    return [call, *sorted(f".{name}" for name in vars(value) if not name.startswith("_") and name not in fields)]


def test_public_names_are_the_frozen_ones() -> None:
    frozen = [line for line in FROZEN.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    now = public_names()
    added, removed = sorted(set(now) - set(frozen)), sorted(set(frozen) - set(now))
    advice = "if meant: python tests/test_api.py, and a line in CHANGELOG.md"
    assert not added and not removed, f"added: {added}; removed: {removed}; {advice}"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_says_what_it_is_and_stands_on_the_page(package: str) -> None:
    module = importlib.import_module(package)
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    for name in module.__all__:
        value = getattr(module, name)
        assert (inspect.getdoc(value) or "").strip(), f"{package}.{name} has no docstring"
        assert re.search(rf"\b{name}\b", page), f"{name}: not in docs/python.md"


def test_importing_the_packages_is_cheap() -> None:
    code = "import sys, cadence, pipeline; sys.exit(bool({'torch', 'numpy', 'pyarrow', 'mcap'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.mark.parametrize("stage", ["ingest", "extract", "infer", "export", "report", "evaluate"])
def test_every_stage_has_the_same_shape(stage: str) -> None:
    module = importlib.import_module(f"pipeline.{stage}.stage")
    parameters = inspect.signature(getattr(module, stage)).parameters
    before, after = {"ingest": ("log",)}.get(stage, ()), {"infer": ("num_threads",)}.get(stage, ())
    assert tuple(parameters) == (*before, "directory", "config", "progress", "force", *after)
    assert parameters["force"].default is False
    assert getattr(module, f"{stage.capitalize()}Config")() is not None, "a stage runs with its defaults"


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    FROZEN.write_text(HEADER + "\n".join(public_names()) + "\n", encoding="utf-8")
    sys.exit(0)
