"""The documentation holds: examples run, commands parse, links and paths lead somewhere, written pages are up to date.

The tables of presets in README.md and the pages docs/api.md and docs/configuration.md are written from the code:

    python tests/test_docs.py     writes them anew
"""

from __future__ import annotations

import ast
import difflib
import importlib
import inspect
import re
import shlex
import typing
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    str(path.relative_to(ROOT)) for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md"))
)
RUN = [page for page in PAGES if "```python\n" in (ROOT / page).read_text(encoding="utf-8")]


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL)


def spans(page: str) -> list[str]:
    """What stands in single backticks, outside blocks."""
    plain = re.sub(r"^```.*?^```", "", text_of(page), flags=re.MULTILINE | re.DOTALL)
    return [span.replace("\\|", "|").replace("\n", " ") for span in re.findall(r"`([^`]+)`", plain)]


@pytest.fixture
def schemes():
    """The registry, in which an example may put a scheme of its own, as it was."""
    from august_jax.schemes import SCHEMES

    before = dict(SCHEMES)
    yield SCHEMES
    SCHEMES.clear()
    SCHEMES.update(before)


LONG = {"docs/files.md", "docs/inference.md", "docs/model.md", "docs/scattering.md", "docs/simulator.md"}
"""Pages whose examples take long, most of it to compile."""


@pytest.mark.parametrize("page", [pytest.param(page, marks=pytest.mark.slow) if page in LONG else page for page in RUN])
def test_every_example_of_a_page_runs_in_order(schemes, page, request):
    if "find_craft" in text_of(page):
        request.getfixturevalue("optimized")
    names: dict = {}
    for block in blocks(page, "python"):
        exec(compile(block, f"{page}: {block.splitlines()[0]}", "exec"), names)


def command_lines(page: str) -> list[list[str]]:
    """The words of every ``august`` command that a page states, in its blocks and in its text."""
    lines = [line for block in blocks(page, "bash") for line in block.splitlines()]
    lines += [span for span in spans(page) if span.startswith("august ")]
    commands = [part.strip() for line in lines for part in line.split("&&")]
    words = [shlex.split(command) for command in commands if command]
    return [each[1:] for each in words if each[0].rsplit("/", 1)[-1] == "august" and not each[1].startswith("-")]


@pytest.mark.parametrize("page", [page for page in PAGES if command_lines(page)])
def test_every_command_line_of_a_page_parses(page):
    from august_jax import config as configuration
    from august_jax.app.cli import COMMANDS
    from august_jax.app.cli.parser import parse

    for words in command_lines(page):
        assert words[0] in COMMANDS, words
        if len(words) > 1:  # otherwise it is the command's name
            arguments = parse(words, COMMANDS)
            assert arguments is not None, words
            preset = configuration.preset(getattr(arguments, "preset", None) or "laptop")
            configuration.override(preset, arguments.overrides)


SMALL = {
    "simulate": ["data.count=20", "data.shard_rows=10"],
    "train": ["train.steps=2", "train.batch=5", "train.log_every=1", "train.save_every=2"],
    "evaluate": ["evaluate.count=2", "evaluate.snr_db=[20]", "evaluate.searched=1"],
    "reconstruct": [],
}
"""What is added to a command that takes hours."""
OURS = ["README.md", "docs/model.md", "docs/results.md"]
"""Pages whose blocks hold commands for one machine; those of docs/scale.md, for a cluster, have tests of their own."""


def lines_to_run(page: str) -> list[str]:
    """The lines of a page's blocks that are a command alone."""
    lines = [line for block in blocks(page, "bash") for line in block.splitlines()]
    return [line for line in lines if line.startswith("august ")]


def test_blocks_of_commands_are_run_or_known():
    assert {page for page in PAGES if lines_to_run(page)} == {*OURS, "docs/scale.md"}


@pytest.mark.slow
@pytest.mark.parametrize("page", OURS)
def test_every_block_of_commands_runs_in_order(page, tmp_path, monkeypatch, optimized):
    """Of a drone of the reader's, with few samples and steps."""
    from august_jax.app import cli
    from august_jax.scene import procedural_airframe

    mesh = procedural_airframe("quad_x", 0.25).mesh
    mesh.export(tmp_path / "drone.stl")
    mesh.export(tmp_path / "hector_quadrotor.ply")
    monkeypatch.chdir(tmp_path)
    for line in lines_to_run(page):
        words = shlex.split(line.replace(",...]", "]"))[1:]
        one_craft = ["target.airframes=[quad_x]"] if "train.source=stream" in words else []
        assert cli.main([*words, *SMALL[words[0]], *one_craft]) == 0, line


@pytest.mark.parametrize("page", PAGES)
def test_every_override_of_a_page_is_one(page):
    """Each stands for itself; where it does not go with one preset it goes with another."""
    from august_jax import config as configuration

    for span in spans(page):
        if re.fullmatch(r"[a-z]+\.\w+=\S+", span) and span != "section.field=value":
            refused = []
            for name in configuration.PRESETS:
                try:
                    configuration.override(configuration.preset(name), [span])
                except configuration.ConfigError as error:
                    refused.append(f"{name}: {error}")
            assert len(refused) < len(configuration.PRESETS), f"{page}: `{span}`\n" + "\n".join(refused)


OUTPUTS = {"checkpoints/", "shard-00000/", "shard-00001/", "august_demo/report.html"}
"""Paths that the commands make."""


@pytest.mark.parametrize("page", PAGES)
def test_every_path_and_link_of_a_page_is_there(page):
    missing = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if re.match(r"https?://", target):
            continue
        path, _, heading = target.partition("#")
        found = (ROOT / page).parent / path if path else ROOT / page
        if not found.is_file():
            missing.append(target)
        elif heading and heading not in anchors(found):
            missing.append(f"{target}: no such heading")
    for span in spans(page):
        for word in span.split():
            kind = re.fullmatch(r"[\w./-]+(/|\.py|\.md|\.toml|\.cff|\.txt|\.ya?ml)", word)
            known = word in OUTPUTS or word.split("/")[-1] == "config.yaml"  # every folder of results has one
            if kind and not known and not any((place / word).exists() for place in (ROOT, ROOT / "august_jax")):
                missing.append(word)
    assert not missing, f"{page}: not there: {', '.join(missing)}"


def anchors(path: Path) -> set[str]:
    """The headings of a page as links name them."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\s-]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def test_the_readme_is_short():
    assert len(text_of("README.md").splitlines()) < 120


PACKAGES = (
    "pipeline",
    "physics",
    "scene",
    "signal",
    "data",
    "models",
    "schemes",
    "tracking",
    "evaluation",
    "evaluation.calibration",
    "training",
    "config",
    "streams",
    "mesh",
    "hosts",
    "memory",
    "files",
    "arrays",
    "progress",
    "constants",
)
"""What docs/api.md lists, in this order, below august_jax."""


def public(package: str) -> list[str]:
    """``__all__``, or the names without an underscore that a module defines itself."""
    module = importlib.import_module(f"august_jax.{package}")
    if hasattr(module, "__all__"):
        return list(module.__all__)
    own = [name for node in tree_of(module.__file__).body for name in defined_by(node)]
    kinds = (typing.TypeVar, typing.ParamSpec)
    return [name for name in own if not name.startswith("_") and not isinstance(getattr(module, name), kinds)]


@cache
def tree_of(path: str) -> ast.Module:
    return ast.parse(Path(path).read_text(encoding="utf-8"))


def defined_by(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [target.id for target in targets if isinstance(target, ast.Name)]


def origin(module: str, name: str) -> tuple[str, str]:
    """The module that defines a name which ``module`` has, and the docstring there, both read from the source."""
    body = tree_of(importlib.import_module(module).__file__).body
    for node, below in zip(body, [*body[1:], ast.Pass()]):
        if name in defined_by(node):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                return module, ast.get_docstring(node) or ""
            constant = below.value if isinstance(below, ast.Expr) else None
            return module, inspect.cleandoc(constant.value) if isinstance(constant, ast.Constant) else ""
        for alias in node.names if isinstance(node, ast.ImportFrom) else ():
            if name == (alias.asname or alias.name):
                return origin(node.module, alias.name)
    raise AssertionError(f"{module} neither defines nor imports {name}")


def first_sentence(text: str) -> str:
    """Of a docstring, with its marks as Markdown has them."""
    text = " ".join(text.split("\n\n")[0].split())
    text = re.split(r"(?<!eq)(?<!eqs)(?<!e\.g)(?<!i\.e)\.\s+(?=[A-Z`\[:])", text)[0].rstrip(".:")
    text = re.sub(r":\w+:`~?\.?([^`]+)`", lambda match: f"`{match[1].removeprefix('august_jax.')}`", text)
    return text.replace("``", "`").replace("|", "\\|") + "."


def api_page() -> str:
    lines = [
        "# Public names",
        "",
        "What the `__all__` of each package holds, and what each plain module defines, with the first sentence of its",
        "docstring; shapes, units and errors follow there. Written by `python tests/test_docs.py`.",
        "",
    ]
    for package in PACKAGES:
        module = importlib.import_module(f"august_jax.{package}")
        lines += [
            f"## august_jax.{package}",
            "",
            first_sentence(module.__doc__ or ""),
            "",
            "| name | in | what |",
            "|---|---|---|",
        ]
        for name in public(package):
            home, text = origin(module.__name__, name)
            text = text or plainly(getattr(module, name))
            lines.append(f"| `{name}` | `{home.removeprefix('august_jax.')}` | {first_sentence(text)} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def plainly(value: object) -> str:
    """What a constant is that says nothing of itself: choices, or a text."""
    choices = typing.get_args(value) if typing.get_origin(value) is typing.Literal else value
    if isinstance(choices, tuple):
        return f"One of {', '.join(map(str, choices))}"
    return f"A text: {value}" if isinstance(value, str) else ""


def configuration_page() -> str:
    from august_jax import config as configuration

    presets = list(configuration.PRESETS)
    lines = [
        "# Configuration",
        "",
        "Every field, with what the presets hold. A field is set with `section.field=value` on the command line, or by",
        "`august_jax.config.override`. Written by `python tests/test_docs.py`.",
        "",
        f"| field | {' | '.join(presets)} | takes | what |",
        "|---" * (len(presets) + 3) + "|",
    ]
    leaves = {name: configuration.leaves(configuration.preset(name)) for name in presets}
    for field in configuration.describe():
        ends = f", {field.bounds[0]:.10g} to {field.bounds[1]:.10g} {field.unit}".rstrip() if field.bounds else ""
        values = [f"`{shown(leaves[name][field.path])}`" for name in presets]
        takes = field.type.replace(" | ", ", ") + ends
        lines.append(f"| `{field.path}` | {' | '.join(values)} | {takes} | {first_sentence(field.doc)} |")
    return "\n".join(lines) + "\n"


def shown(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{','.join(map(shown, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


def readme() -> str:
    """README.md with the table of presets as the code has it."""
    from august_jax import config as configuration

    head, first, rest = text_of("README.md").partition("| preset |")
    assert first, "README.md: the table of presets is gone"
    table = ["| preset | what for | command | takes | expect |", "|---|---|---|---|---|"]
    for name, each in configuration.PRESETS.items():
        table.append(f"| `{name}` | {each.summary} | `{each.command}` | {each.time} | {each.expected} |")
    after = [line for line in rest.splitlines()[1:]]
    while after and after[0].startswith("|"):
        after.pop(0)
    return head + "\n".join([*table, *after]) + "\n"


WRITTEN = {"README.md": readme, "docs/api.md": api_page, "docs/configuration.md": configuration_page}


@pytest.mark.parametrize("page", WRITTEN)
def test_written_pages_are_up_to_date(page):
    """Names that are missing, names that are left over, sentences that have changed."""
    wanted = WRITTEN[page]()
    if text_of(page) != wanted:
        changed = difflib.unified_diff(
            text_of(page).splitlines(), wanted.splitlines(), page, "the code", lineterm="", n=0
        )
        pytest.fail(
            f"{page} is not what the code says; write it anew: python tests/test_docs.py\n" + "\n".join(changed)
        )


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_says_what_it_is(package):
    """And is there: __all__ promises it."""
    module = importlib.import_module(f"august_jax.{package}")
    section = text_of("docs/api.md").partition(f"## august_jax.{package}\n")[2].partition("\n## ")[0]
    listed = re.findall(r"^\| `(\w+)` \| `([\w.]+)` \| (.+) \|$", section, re.MULTILINE)
    assert {name for name, _, _ in listed} == set(public(package))
    for name, _, what in listed:
        assert hasattr(module, name) and len(what) > 5, f"august_jax.{package}.{name} has no docstring"


if __name__ == "__main__":
    for page, make in WRITTEN.items():
        (ROOT / page).write_text(make(), encoding="utf-8")
        print(f"wrote {page}")
