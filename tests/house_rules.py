"""What no source file may do: each rule takes a file's name and content and returns its offences."""

import ast
import functools
from pathlib import Path

MAY_IMPORT = {
    "cli": {"cli", "pipeline", "cadence"},
    "pipeline": {"pipeline", "cadence", "schemas"},
    "cadence": {"cadence"},
    "schemas": {"schemas"},
}
# cli knows the exceptions and nothing else of the estimators.
CLI_MAY_IMPORT_FROM_CADENCE = {"cadence.errors"}
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "joblib", "cloudpickle", "marshal", "shelve"}
# What would make `cadence` depend on the world outside its arguments.
NOT_IN_CADENCE = {
    "os",
    "io",
    "time",
    "datetime",
    "pathlib",
    "json",
    "sys",
    "subprocess",
    "mcap",
    "pyarrow",
    "typer",
    "tqdm",
    "tempfile",
}
GPL_PACKAGES = {"small_mcap", "pymcap_cli", "mcap_ros2_support_fast", "mcap_codec_support", "ros_parser"}
FORBIDDEN_NAMES = {"utils", "util", "helpers", "helper", "common", "misc", "manager", "managers", "factory", "registry"}
# Of the modules for random numbers what has no state of its own; all else draws from a stream that every library shares.
NOT_GLOBAL_RANDOM = {
    "random": {"Random"},
    "numpy.random": {"default_rng", "Generator", "SeedSequence", "BitGenerator", "PCG64", "Philox"},
}
DRAWS_OF_TORCH = {"rand", "randn", "randint", "randperm", "normal", "bernoulli", "multinomial", "poisson"}
DRAWS_OF_TORCH |= {"rand_like", "randn_like", "randint_like"}
DRAWS_IN_PLACE = {"normal_", "uniform_", "random_", "exponential_", "bernoulli_", "log_normal_", "cauchy_", "geometric_"}
GLOBAL_SEEDING = {"manual_seed", "manual_seed_all", "seed", "seed_all", "set_rng_state", "set_rng_state_all"}
RECURRENT_LAYERS = {"LSTM", "GRU", "RNN", "LSTMCell", "GRUCell", "RNNCell"}

MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 60
LONG_FILES: dict[str, str] = {"cli.py": "one function and its help a command"}  # path: the reason why it is one file
RECURRENT_FILE = "cadence/network/recurrent.py"  # where they are kept in float32
LONG_FUNCTIONS: dict[str, str] = {}  # path::function: the reason why it is one function


@functools.cache
def nodes_of(tree: ast.Module) -> tuple[ast.AST, ...]:
    """All nodes of a module; most of what a rule costs is to walk over them."""
    return tuple(ast.walk(tree))


def imported_modules(tree: ast.Module) -> set[str]:
    found = set()
    for node in nodes_of(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import; write the full name"
            found.add(node.module or "")
    return found


def wrong_imports(name: str, tree: ast.Module) -> list[str]:
    """Imports of a higher layer, of what is forbidden, and by `cadence` of the world outside."""
    layer = name.split("/")[0].removesuffix(".py")
    modules = imported_modules(tree)
    tops = {module.split(".")[0]: module for module in sorted(modules)}
    wrong = {module for top, module in tops.items() if top in MAY_IMPORT and top not in MAY_IMPORT[layer]}
    wrong |= {module for top, module in tops.items() if top in FORBIDDEN_MODULES | GPL_PACKAGES}
    if layer == "cli":
        wrong |= {module for module in modules if module.startswith("cadence")} - CLI_MAY_IMPORT_FROM_CADENCE
    if layer == "cadence":
        wrong |= {module for top, module in tops.items() if top in NOT_IN_CADENCE}
    return [f"{name} must not import {module}" for module in sorted(wrong)]


def unwanted(name: str, tree: ast.Module) -> list[str]:
    """Names that say nothing, printing, evaluated text, exceptions swallowed, globals, recurrent layers outside their place."""
    found = [f"{name}: says nothing of what is in it"] if Path(name).stem in FORBIDDEN_NAMES else []
    aliases = aliases_in(tree)
    for node in nodes_of(tree):
        where = f"{name}, line {getattr(node, 'lineno', '?')}"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            found += [f"{where}: {node.func.id}"] if node.func.id in ("print", "eval", "exec", "input") else []
        if isinstance(node, ast.ExceptHandler):
            is_broad = node.type is None or ast.unparse(node.type) in ("Exception", "BaseException")
            is_silent = all(isinstance(statement, ast.Pass) for statement in node.body)
            if node.type is None or (is_broad and is_silent):
                found.append(f"{where}: an exception of any kind is caught or swallowed")
        if isinstance(node, ast.Global):
            found.append(f"{where}: global {node.names}")
        if isinstance(node, ast.Attribute | ast.Name):
            last = node.attr if isinstance(node, ast.Attribute) else node.id
            if last in RECURRENT_LAYERS and full_name(node, aliases) == f"torch.nn.{last}" and name != RECURRENT_FILE:
                found.append(f"{where}: {last}; take the one of {RECURRENT_FILE}")
    return found


def aliases_in(tree: ast.Module) -> dict[str, str]:
    """What the names that a module imports stand for: np -> numpy, manual_seed -> torch.random.manual_seed."""
    found = {}
    for node in nodes_of(tree):
        if isinstance(node, ast.Import):
            found |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return found


def full_name(node: ast.expr, aliases: dict[str, str]) -> str:
    """The dotted name of what an expression stands for, as far as imports tell."""
    attributes = []
    while isinstance(node, ast.Attribute):
        attributes.append(node.attr)
        node = node.value
    first = aliases.get(node.id, node.id) if isinstance(node, ast.Name) else ast.unparse(node)
    return ".".join([first, *reversed(attributes)])


def global_randomness(name: str, tree: ast.Module) -> list[str]:
    """Draws from streams that all share, and seeds of theirs, unless torch's is put back afterwards (`fork_rng`)."""
    aliases, found = aliases_in(tree), []
    with_blocks = [node for node in nodes_of(tree) if isinstance(node, ast.With)]
    forks = [block for block in with_blocks if any("fork_rng(" in ast.unparse(item) for item in block.items)]
    is_put_back = {id(node) for block in forks for node in ast.walk(block)}
    for node in nodes_of(tree):
        if not isinstance(node, ast.Call):
            continue
        called = full_name(node.func, aliases)
        owner, _, function = called.rpartition(".")
        has_generator = any(keyword.arg == "generator" for keyword in node.keywords)
        is_torch = owner == "torch" or owner.startswith("torch.")
        if (
            (owner in NOT_GLOBAL_RANDOM and function not in NOT_GLOBAL_RANDOM[owner])
            or (owner == "torch" and function in DRAWS_OF_TORCH and not has_generator)
            or (function in DRAWS_IN_PLACE and owner != "torch.nn.init" and not has_generator)
            or (is_torch and function in GLOBAL_SEEDING and "Generator(" not in owner and id(node) not in is_put_back)
        ):
            found.append(f"{name}, line {node.lineno}: {called} shares its stream with everybody; use a generator of your own")
    return found


def too_long(name: str, text: str) -> list[str]:
    """Files and functions over their limits that have no reason."""
    num_lines = len(text.splitlines())
    found = [f"{name}: {num_lines} lines"] if num_lines > MAX_FILE_LINES and name not in LONG_FILES else []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length, key = (node.end_lineno or node.lineno) - node.lineno + 1, f"{name}::{node.name}"
            found += [f"{key}: {length} lines"] if length > MAX_FUNCTION_LINES and key not in LONG_FUNCTIONS else []
    return [f"{item}: split it, or give the reason" for item in found]
