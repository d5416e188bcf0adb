"""Who may import whom: the rules that keep data flowing one way, read from the source, and a light top-level import."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import august_jax

ROOT = Path(august_jax.__file__).parent
BASE = {"constants", "config", "files", "arrays", "progress", "streams", "mesh", "hosts", "memory"}
ALLOWED = {
    "constants": set(),
    "arrays": set(),
    "progress": set(),
    "mesh": set(),
    "hosts": set(),
    "memory": set(),
    "streams": {"arrays"},
    "files": set(),
    "config": BASE,
    "physics": BASE,
    "scene": BASE | {"physics.cells"},
    "signal": BASE | {"physics"},
    "data": BASE | {"physics", "scene", "signal"},
    "inference": BASE | {"data", "physics", "scene", "signal"},
    "models": BASE | {"signal.roi"},
    "tracking": BASE | {"signal", "models"},
    "training": BASE | {"models", "data", "scene.trajectory", "tracking.predictors"},
    "schemes": BASE | {"inference", "models", "tracking", "signal", "scene", "physics"},
    "evaluation": BASE | {"schemes", "inference", "data", "tracking", "models", "physics", "signal", "scene"},
    "pipeline": BASE | {"schemes", "data", "tracking", "models", "physics", "scene", "training.checkpoint"},
}
"""First part of a module's name -> what it may import besides itself."""
ON_TOP = {"app"}
"""What stands on top and may import everything."""
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
    typing_only = [
        node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    ]
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


@pytest.mark.parametrize("room", [room for room, allowed in ALLOWED.items() if allowed - BASE])
def test_no_room_is_allowed_what_it_does_not_use(room):
    """A rule that nobody needs is a door left open."""
    used = {
        target.removeprefix("august_jax.")
        for name, path in MODULES.items()
        if name.split(".")[0] == room
        for target in imports(path, name)
        if target.startswith("august_jax.")
    }
    idle = [place for place in ALLOWED[room] - BASE if not any(within(target, [place]) for target in used)]
    assert not idle, f"{room} does not use {', '.join(idle)}: take them out of ALLOWED"


def test_every_rule_is_about_something_that_is_there():
    rooms = {name.split(".")[0] for name in MODULES if name}
    assert rooms == set(ALLOWED) | ON_TOP
    owners = {place for places in OWNERS.values() for place in places}
    for place in owners:
        assert any(within(name, [place]) for name in MODULES), f"{place} owns a package but is no module"
    for package, places in OWNERS.items():
        users = {
            name for name, path in MODULES.items() for target in imports(path, name) if target.split(".")[0] == package
        }
        idle = [place for place in places if not any(within(name, [place]) for name in users)]
        assert not idle, f"{package}: {', '.join(idle)} does not import it"


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
