"""Scripts beside the package, experiments and benchmarks: found by what they define, imported, run in this process."""

from __future__ import annotations

import ast
import importlib.util
import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent


def defining(folder: str, *functions: str) -> list[str]:
    """Names of the scripts of a folder that define all of these functions; nothing is imported for it."""

    def defined(path: Path) -> set[str]:
        return {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}

    return [path.stem for path in sorted((ROOT / folder).glob("*.py")) if set(functions) <= defined(path)]


def imported(folder: str, name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A script as a module: its neighbours are found as they are when it is run."""
    monkeypatch.syspath_prepend(ROOT / folder)
    spec = importlib.util.spec_from_file_location(f"{folder}_{name}", ROOT / folder / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # where a dataclass looks its annotations up
    spec.loader.exec_module(module)
    return module


def run(folder: str, name: str, *arguments: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A script as ``python FOLDER/NAME.py ARGUMENTS`` runs it."""
    monkeypatch.syspath_prepend(ROOT / folder)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
    runpy.run_path(str(ROOT / folder / f"{name}.py"), run_name="__main__")
