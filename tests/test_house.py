"""Who may import whom: the rules that keep data flowing one way, read from the source, and a light top-level import."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import august_jax

ROOT = Path(august_jax.__file__).parent
BASE = {"constants", "config", "files", "arrays", "progress", "streams"}
ALLOWED = {
    "constants": set(),
    "config": set(),
    "files": set(),
    "arrays": set(),
    "progress": set(),
    "streams": set(),
    "physics": BASE,
    "signal": BASE | {"physics"},
    "scene": BASE | {"physics.cells"},
    "data": BASE | {"physics", "scene", "signal"},
    "models": BASE | {"signal.roi", "data.fields"},
    "metrics": BASE,
    "training": BASE | {"models", "data"},
    "tracking": BASE | {"models", "signal"},
}
"""First part of a module's name -> what it may import besides itself; what is not named here stands on top."""
ON_TOP = {"pipeline", "evaluation", "app"}
OWNERS = {
    "trimesh": {"scene.airframes"},
    "distrax": {"models.flow"},
    "optax": {"training"},
    "orbax": {"training.checkpoint"},
    "matplotlib": {"app.plotting"},
}
"""Third-party package -> the only modules that may import it."""


def modules():
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        yield ".".join(part for part in parts if part != "__init__"), path


def imports(path, name):
    """Absolute dotted names of everything a module imports for use, at its top or inside a function."""
    tree = ast.parse(path.read_text())
    typing_only = [node for node in ast.walk(tree)
                   if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)]
    skipped = {inner for node in typing_only for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import; imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def within(name, places):
    return any(name == place or name.startswith(place + ".") for place in places)


MODULES = dict(modules())


@pytest.mark.parametrize("name", [name for name in MODULES if name])
def test_imports_follow_the_house(name):
    room = name.split(".")[0]
    assert room in ALLOWED or room in ON_TOP, f"{name}: say in this test what it may import"
    for target in imports(MODULES[name], name):
        if target.startswith("august_jax."):
            inner = target.removeprefix("august_jax.")
            if room in ALLOWED and inner != "__version__":
                assert within(inner, ALLOWED[room] | {room}), f"{name} must not import {inner}"
        else:
            package = target.split(".")[0]
            assert within(name, OWNERS.get(package, {name})), f"{name} must not import {package}"


def loaded_by(statement):
    code = f"import sys; {statement}; print(*sys.modules)"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_top_level_import_loads_nothing_heavy_but_jax():
    heavy = {"flax", "distrax", "optax", "orbax", "trimesh", "matplotlib", "tensorflow_probability"}
    names = loaded_by("import august_jax")
    assert not heavy & set(names)
    assert not [name for name in names if name.startswith("august_jax.")]


def test_help_needs_neither_jax_nor_numpy():
    names = loaded_by("import august_jax.app.cli; assert august_jax.app.cli.main(['--help']) == 0")
    assert not {"jax", "numpy", "yaml"} & set(names)
