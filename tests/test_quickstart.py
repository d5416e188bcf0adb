"""The notebook runs from top to bottom, and a wheel works where there is no checkout."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NOTEBOOK = ROOT / "docs" / "quickstart.ipynb"


def code_cells() -> list[str]:
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def test_the_notebook_is_one_and_holds_no_outputs():
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4 and len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    assert all(
        not cell["outputs"] and cell["execution_count"] is None for cell in notebook["cells"] if "outputs" in cell
    )
    for number, cell in enumerate(code_cells()):
        compile(cell, f"cell {number}", "exec")


def test_links_of_the_notebook_lead_somewhere():
    for target in re.findall(r"\]\(([^)]+)\)", NOTEBOOK.read_text(encoding="utf-8")):
        assert (NOTEBOOK.parent / target.replace("\\n", "")).is_file(), target


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for number, cell in enumerate(code_cells()):
        exec(compile(cell, f"cell {number}", "exec"), names)
    said = capsys.readouterr().out
    assert "found to" in said and "prediction" in said
    # the far field's fourth power, of a body and an array of half a metre at nine
    assert 3.7 < float(names["powers"]) < 4.3
    assert len(names["figure"].axes) == 3


def elsewhere() -> dict[str, str]:
    """The environment of a process that does not find this checkout."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy, in which nothing is left over from other builds."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "august_jax", source / "august_jax", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    words = [sys.executable, "-m", "pip", "wheel", "--no-deps", "-q", "-w", str(folder), str(source)]
    built = subprocess.run(words, capture_output=True, text=True, env=elsewhere())
    if built.returncode:
        pytest.skip(f"no wheel can be built here: {built.stderr.strip().splitlines()[-1:]}")
    return next(folder.glob("*.whl"))


@pytest.mark.slow
def test_the_wheel_holds_all_that_is_not_code(wheel):
    with zipfile.ZipFile(wheel) as file:
        held = set(file.namelist())
    data = [path.relative_to(ROOT).as_posix() for path in (ROOT / "august_jax").rglob("*")
            if path.is_file() and path.suffix != ".pyc"]  # fmt: skip
    assert not set(data) - held
    assert {"august_jax/app/viewer.html", "august_jax/py.typed", "august_jax/weights/laptop/weights.npz"} <= held
    assert not [name for name in held if name.startswith(("tests/", "experiments/", "benchmarks/", "docs/"))]


@pytest.mark.slow
def test_the_wheel_demos_in_an_empty_folder(wheel, tmp_path):
    """In an environment of its own, which borrows the packages that it needs from this one."""
    place, empty = tmp_path / "venv", tmp_path / "empty"
    empty.mkdir()
    venv.create(place, with_pip=True, symlinks=True)
    python = place / "bin" / "python"
    subprocess.run(
        [python, "-m", "pip", "install", "-q", "--no-deps", str(wheel)], check=True, cwd=empty, env=elsewhere()
    )
    site = next((place / "lib").glob("python*/site-packages"))
    borrowed = [each for each in sys.path if each.endswith("site-packages")]
    (site / "borrowed.pth").write_text("\n".join(borrowed) + "\n")
    words = [place / "bin" / "august", "demo", "--slots", "2", "--search", "0", "--json"]
    run = subprocess.run(words, cwd=empty, env=elsewhere(), capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    where = subprocess.run(
        [python, "-c", "import august_jax; print(august_jax.__file__)"], cwd=empty, env=elsewhere(),
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert Path(where.stdout.strip()).is_relative_to(place)
    assert {path.name for path in (empty / "august_demo").iterdir()} == set(result["files"])
    assert (empty / "august_demo" / "report.html").stat().st_size > 40_000 and len(result["slots"]) == 2
