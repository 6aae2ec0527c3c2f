"""The plan of the house, held by its source code: who may import whom, and what must not be written at all."""

import ast
import functools
import graphlib
from collections import Counter
from pathlib import Path

import pytest
from house_rules import (
    LONG_FILES,
    LONG_FUNCTIONS,
    MAX_FILE_LINES,
    MAX_FUNCTION_LINES,
    global_randomness,
    nodes_of,
    too_long,
    unwanted,
    wrong_imports,
)

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(
    [ROOT / "cli.py", *(path for layer in ("cadence", "pipeline", "schemas") for path in (ROOT / layer).rglob("*.py"))]
)
# Inside a layer, from the ground up: what stands on a floor may import what stands below it, and nothing beside it.
FLOORS = {
    "cadence": (
        {"arrays", "errors", "schedule"},
        {"constraints", "measurement", "metrics", "resampling", "seeds"},
        {"association", "stories", "types"},
        {"bank", "height", "recordings"},
        {"evidence", "network", "worlds"},
        {"answers", "bearings", "diffusion"},
        {"baselines", "retrospect"},
        {"training"},
    ),
    "pipeline": (
        {"clock", "counted", "documents", "lengths", "moments", "out_of_memory", "suggestions"},
        {
            "accuracies",
            "arrays",
            "config",
            "height_words",
            "place_words",
            "locks",
            "progress",
            "provenance",
            "plain_rows",
            "presence",
            "obstacle_file",
            "score_words",
            "look_files",
            "measurement_words",
            "stream_words",
            "suspicions",
            "threads",
        },
        {"files"},
        {"manifest", "tables"},
        {"frames", "stores", "logs", "mapping", "tracks"},
        {"missions", "checkpoints", "grids", "looks", "measurements", "results", "stories"},
        {"weights", "windows"},
        {"catalogue", "associations"},
        {"ask", "estimators", "pasts", "scoring"},
        {"ingest", "extract", "infer", "retrospect", "export", "report", "simulate", "importing"},  # no stage imports another
        {"episodes"},
        {"forecast", "train"},
        {"evaluate"},
        {"batch", "inspect"},
        {"front", "takeaway", "view"},
    ),
}


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def source_modules() -> dict[str, Path]:
    """Every module of the layers by its dotted name."""
    found = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in SOURCES}
    return {name.removesuffix(".__init__"): path for name, path in found.items()}


def imports_within(modules: dict[str, ast.Module]) -> dict[str, set[str]]:
    """Which of the modules each of them imports, those behind TYPE_CHECKING counted."""
    arrows: dict[str, set[str]] = {}
    for name, tree in modules.items():
        found = set()
        for node in nodes_of(tree):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= {item if item in modules else node.module for item in inner}
        arrows[name] = {item for item in found if item in modules and item != name}
    return arrows


def room_of(module: str) -> str:
    """The package of a module inside its layer, or the module itself where it stands in none."""
    return module.split(".")[1] if "." in module else module


def upward_imports(arrows: dict[str, set[str]], layer: str) -> list[str]:
    """Imports between rooms of a layer that do not point downwards."""
    height = {room: number for number, floor in enumerate(FLOORS[layer]) for room in floor}
    wrong = []
    for module, imported in sorted(arrows.items()):
        for other in sorted(imported):
            rooms = room_of(module), room_of(other)
            inside = module.startswith(f"{layer}.") and other.startswith(f"{layer}.") and rooms[0] != rooms[1]
            if inside and height[rooms[0]] <= height[rooms[1]]:
                wrong.append(f"{module} imports {other}")
    return wrong


def circle_of(arrows: dict[str, set[str]]) -> list[str]:
    """A circle of imports, or nothing."""
    try:
        tuple(graphlib.TopologicalSorter(arrows).static_order())
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def found_in_sources(rule) -> dict[str, object]:
    """What a rule of a name and a tree finds, by file: one test a rule, since one a file costs more than all files."""
    return {name_of(path): found for path in SOURCES if (found := rule(name_of(path), tree_of(path)))}


def test_imports_point_downwards():
    assert not found_in_sources(wrong_imports)


@pytest.fixture(scope="module")
def arrows() -> dict[str, set[str]]:
    return imports_within({name: tree_of(path) for name, path in source_modules().items()})


@pytest.mark.parametrize("layer", FLOORS)
def test_packages_stand_on_floors_and_import_downwards(arrows, layer):
    rooms = {room_of(module) for module in arrows if module.startswith(f"{layer}.")}
    assert rooms == set().union(*FLOORS[layer]), "a room without a floor, or a floor without its room"
    assert not upward_imports(arrows, layer)


def test_no_module_imports_itself_in_a_circle(arrows):
    assert not circle_of(arrows)


def test_planted_offences_against_the_order_are_caught():
    planted = {
        "pipeline.infer.stage": "from pipeline.extract import thinning\nimport pipeline.windows",
        "pipeline.extract.thinning": "",
        "pipeline.windows": "if TYPE_CHECKING:\n    from pipeline.infer.stage import infer",
    }
    arrows = imports_within({name: ast.parse(text) for name, text in planted.items()})
    assert upward_imports(arrows, "pipeline") == [
        "pipeline.infer.stage imports pipeline.extract.thinning",
        "pipeline.windows imports pipeline.infer.stage",
    ]
    assert set(circle_of(arrows)) == {"pipeline.infer.stage", "pipeline.windows"}


def test_nothing_that_the_house_does_without():
    assert not found_in_sources(unwanted)


def test_no_global_random_state():
    assert not found_in_sources(global_randomness)


def test_files_and_functions_stay_readable():
    long = {name_of(path): too_long(name_of(path), path.read_text(encoding="utf-8")) for path in SOURCES}
    assert not {name: found for name, found in long.items() if found}


def test_exceptions_from_the_limits_are_needed():
    sizes = {name_of(path): len(path.read_text(encoding="utf-8").splitlines()) for path in SOURCES}
    assert all(sizes.get(name, 0) > MAX_FILE_LINES for name in LONG_FILES)
    lengths = {
        f"{name_of(path)}::{node.name}": (node.end_lineno or 0) - node.lineno + 1
        for path in SOURCES
        for node in nodes_of(tree_of(path))
        if isinstance(node, ast.FunctionDef)
    }
    assert all(lengths.get(name, 0) > MAX_FUNCTION_LINES for name in LONG_FUNCTIONS)


def test_command_line_stays_thin():
    # most of it is help: one function and its help a command, and a question of `cadence ask` is one
    assert len((ROOT / "cli.py").read_text(encoding="utf-8").splitlines()) < 650


def test_top_level_is_what_the_plan_says():
    folders = {path.name for path in ROOT.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert folders <= {"cadence", "pipeline", "schemas", "tests", "benchmarks", "docs"}
    assert {path.name for path in ROOT.glob("*.py")} == {"cli.py"}


def test_no_two_test_files_share_a_name():
    """Pytest would refuse the second, but only where both are collected in one run."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("*.py"))
    assert [name for name, count in names.items() if count > 1] == []


def test_every_test_file_has_a_name_of_its_own():
    # pytest imports them by their names alone
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert len(names) == len(set(names)), sorted({name for name in names if names.count(name) > 1})
