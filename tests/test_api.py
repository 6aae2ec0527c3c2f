"""The public interface, frozen: whoever changes a name that others may use changes tests/api.txt in the same commit.

Write it anew with: python tests/test_api.py
"""

import ast
import importlib
import inspect
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FROZEN = Path(__file__).with_name("api.txt")
HEADER = "# Public names (see tests/test_api.py): what packages export, and what the modules at the top of each layer define.\n"


def public_names() -> list[str]:
    """`module.name(parameters)` for functions, `module.Name` for classes and constants."""
    found = []
    for layer in ("cadence", "pipeline", "schemas"):
        for path in sorted((ROOT / layer).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if path.name == "__init__.py":
                found += [f"{'.'.join(parts[:-1])}.{name}" for name in exported(path)]
            elif len(parts) == 2:
                found += [f"{'.'.join(parts)}.{name}" for name in defined(path)]
    return sorted(found)


def exported(path: Path) -> list[str]:
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "__all__":
            return list(ast.literal_eval(node.value))
    return []


def defined(path: Path) -> list[str]:
    names = []
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            arguments = node.args
            every = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
            names.append(f"{node.name}({', '.join(every)})")
        elif isinstance(node, ast.ClassDef):
            names.append(node.name)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id.isupper():
            names.append(node.targets[0].id)
    return [name for name in names if not name.startswith("_")]


def test_public_names_are_the_frozen_ones():
    frozen = [line for line in FROZEN.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    now = public_names()
    added, removed = sorted(set(now) - set(frozen)), sorted(set(frozen) - set(now))
    advice = "if meant: python tests/test_api.py, and a line in CHANGELOG.md"
    assert not added and not removed, f"added: {added}; removed: {removed}; {advice}"


def test_what_is_exported_can_be_imported():
    for path in sorted((ROOT / "cadence").rglob("__init__.py")):
        package = ".".join(path.relative_to(ROOT).parent.parts)
        module = importlib.import_module(package)
        assert all(hasattr(module, name) for name in exported(path)), package


@pytest.mark.parametrize("stage", ["ingest", "extract", "infer", "export", "report", "evaluate"])
def test_every_stage_has_the_same_shape(stage):
    module = importlib.import_module(f"pipeline.{stage}.stage")
    parameters = list(inspect.signature(getattr(module, stage)).parameters.values())
    wanted = ["directory", "config", "progress", "force"]
    assert [parameter.name for parameter in parameters] == (["log", *wanted] if stage == "ingest" else wanted)
    assert parameters[-1].default is False
    assert getattr(module, f"{stage.capitalize()}Config")() is not None, "a stage runs with its defaults"


if __name__ == "__main__":
    FROZEN.write_text(HEADER + "\n".join(public_names()) + "\n", encoding="utf-8")
    sys.exit(0)
