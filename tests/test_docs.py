"""Documentation that cannot rot: what a page names exists, what it tells people to type is accepted."""

import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
import typer.main

import cli
from pipeline.config import TABLES, merge_overrides, read_config
from schemas import channels, tables

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))

import generate  # noqa: E402  (a script beside the pages, not a package)

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
COMMANDS = typer.main.get_command(cli.app).commands


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def blocks(text: str, *languages: str) -> list[str]:
    return re.findall(rf"^```(?:{'|'.join(languages)})\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def shell_lines(text: str) -> list[str]:
    lines = "\n".join(blocks(text, "sh", "console", "bash")).replace("\\\n", " ").splitlines()
    return [line.removeprefix("$ ").strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def quoted(text: str) -> list[str]:
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))


def every_page(test):
    return pytest.mark.parametrize("page", PAGES, ids=name_of)(test)


def test_pages_that_people_look_for_are_there():
    names = {name_of(page) for page in PAGES}
    wanted = {"README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md"}
    wanted |= {f"docs/{name}.md" for name in ("glossary", "formats", "cli", "configuration")}
    assert wanted <= names


def test_the_readme_is_read_in_minutes():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 900


@pytest.mark.parametrize(("name", "make"), [("cli.md", generate.cli_page), ("configuration.md", generate.configuration_page)])
def test_generated_pages_are_up_to_date(name, make):
    assert (ROOT / "docs" / name).read_text(encoding="utf-8") == make(), "call: make docs"


def config_classes(cls, name):
    yield name, cls
    for hint in generate.typing.get_type_hints(cls).values():
        nested = generate._nested(hint)
        if nested is not None:
            yield from config_classes(nested, f"{name}.{nested.__name__}")


@pytest.mark.parametrize("table", TABLES)
def test_every_setting_has_a_meaning(table):
    for name, cls in config_classes(generate.stage_config_class(table), table):
        missing = [key for key, _, _, meaning in generate.fields_of(cls) if not meaning]
        assert not missing, f"{name}: say in the docstring of {cls.__name__} what {missing} mean"


@every_page
def test_links_and_pictures_resolve(page):
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'(?:src|href)="([^"]+)"', text)
    for target in targets:
        if not target.startswith(("http:", "https:", "mailto:", "#")):
            path, _, anchor = target.partition("#")
            assert (page.parent / path).exists(), f"{target} does not exist"
            if anchor:
                headings = re.findall(r"^#+ (.+)$", (page.parent / path).read_text(encoding="utf-8"), flags=re.MULTILINE)
                assert anchor in {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@every_page
def test_commands_are_accepted(page):
    for line in shell_lines(page.read_text(encoding="utf-8")):
        words = shlex.split(line, comments=True)
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
            words = words[1:]
        if words[:1] == ["make"]:
            assert set(words[1:]) <= set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)), line
        if words and words[0].rpartition("/")[2] == "cadence":
            assert_accepted(words[1:], line)


def assert_accepted(words: list[str], line: str) -> None:
    """The command exists, parses, and every `--set` in it names a key."""
    if words in (["--help"], ["--version"]):
        return
    assert words and words[0] in COMMANDS, line
    command = COMMANDS[words[0]]
    if "--help" in words:
        return
    try:
        context = command.make_context(words[0], list(words[1:]))
    except typer.TyperException as error:
        raise AssertionError(f"{line}: {error.format_message()}") from error
    if words[0] == "ask" and len(words) > 2:
        assert words[2] in command.commands, line
        command.commands[words[2]].make_context(words[2], list(words[3:]))
    assert_tables_fit(merge_overrides({}, context.params.get("settings") or ()), line)


def assert_tables_fit(configuration: dict, where: str) -> None:
    for name, table in configuration.items():
        assert name in TABLES, f"{where}: no table {name}"
        read_config(generate.stage_config_class(name), table, name)


@every_page
def test_configuration_examples_are_accepted(page):
    for block in blocks(page.read_text(encoding="utf-8"), "toml"):
        assert_tables_fit(tomllib.loads(block), name_of(page))


@every_page
def test_flags_and_settings_in_sentences_exist(page):
    commands = [*COMMANDS.values(), *COMMANDS["ask"].commands.values()]
    known_flags = {flag for command in commands for option in command.params for flag in option.opts}
    known_flags |= {"--version", "--help"}
    for words in quoted(page.read_text(encoding="utf-8")):
        flag = re.match(r"--[a-z-]+", words)
        if flag and name_of(page) != "CONTRIBUTING.md":
            assert flag[0] in known_flags, f"`{words}`: no command has {flag[0]}"
        setting = re.fullmatch(rf"({'|'.join(TABLES)})\.([a-z_.]+)(?:=.*)?", words)
        if setting and not re.search(r"\.(py|json|parquet|toml|html|mcap|md)$", words):
            cls = generate.stage_config_class(setting[1])
            for part in setting[2].split("."):
                hints = generate.typing.get_type_hints(cls)
                assert part in hints, f"`{words}`: {cls.__name__} has no {part}"
                cls = generate._nested(hints[part]) or cls
        if words.startswith("make ") and re.fullmatch(r"make [a-z]+", words):
            assert f"\n{words[5:]}:" in (ROOT / "Makefile").read_text(), words


@every_page
def test_files_that_are_named_exist(page):
    for words in quoted(page.read_text(encoding="utf-8")):
        if re.fullmatch(r"(?:cadence|pipeline|schemas|tests|benchmarks|docs)/[\w./-]+", words):
            assert (ROOT / words).exists(), f"`{words}` does not exist"


def test_architecture_names_every_package_and_stage():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    packages = [path.parent for layer in ("cadence", "pipeline", "schemas") for path in (ROOT / layer).rglob("__init__.py")]
    missing = [name_of(package) for package in packages if f"{name_of(package)}/" not in text]
    assert not missing
    assert all(f"pipeline/{table}" in text for table in TABLES)


def test_formats_page_names_every_column_topic_and_field():
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    schemas = (
        tables.DETECTIONS,
        tables.TRUTH,
        tables.POSES,
        tables.WINDOWS,
        tables.MISSION,
        tables.PASTS,
        tables.hypotheses_schema(1),
    )
    names = {name for schema in schemas for name in schema.names}
    names |= {value.topic for value in vars(channels).values() if isinstance(value, channels.Channel)}
    for kind in ("Hypotheses", "Agents", "Detection"):
        descriptor = channels.message_class(f"cadence.{kind}").DESCRIPTOR
        names |= {field.name for field in descriptor.fields}
    assert not sorted(name for name in names if f"`{name}`" not in text)


def test_changelog_starts_with_this_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    first = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert first and first[1] == version


def test_every_pinned_version_is_exact_and_every_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", line) for line in lines)
    pinned = {line.partition("==")[0].lower().replace("_", "-") for line in lines}
    wanted = [*project["dependencies"], *(name for extra in project["optional-dependencies"].values() for name in extra)]
    assert {re.match(r"[A-Za-z0-9._-]+", name)[0].lower() for name in wanted} <= pinned | {"cadence"}  # its own extras
    assert "torch==2.13.0" in lines
