"""Help says of every option what it takes and what it is where it is left out; shells complete them."""

import re
import shutil
import subprocess

import pytest

from august_jax.app import cli
from august_jax.app.cli.messages import worded
from august_jax.app.cli.parser import parser_of
from august_jax.config import describe
from august_jax.scene.mesh_files.frame import AUTO, AXES, UNITS_M
from august_jax.schemes import SCHEMES
from august_jax.tracking.predictors import PREDICTORS

PLAIN = {"--seed", "--slots", "--search", "--known", "--devices", "--index", "--shard", "--host", "--permittivity"}
"""Numbers that have no unit."""


def options(name):
    """Option -> its text in the help of a command, in one line."""
    parser = parser_of(name, cli.COMMANDS[name])
    formatter = parser._get_formatter()
    taken = [action for action in parser._actions if action.option_strings and action.nargs != 0]
    return {action: " ".join(formatter._expand_help(action).split()) for action in taken}


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_option_says_its_default_and_its_range(name):
    for action, text in options(name).items():
        flag = action.option_strings[-1]
        assert "default" in text or "required" in text, f"{name} {flag}: {text}"
        if hasattr(action.type, "takes"):
            assert action.type.takes in text, f"{name} {flag}: {text}"
        else:
            assert action.type is None, f"{name} {flag}: its type does not say what it takes"
        numeric = action.type is not None and not hasattr(action.type, "known")
        assert not numeric or flag in PLAIN or re.search(r"\[[^\]]*(m|m/s|deg|dB|GHz|Hz|s|turns/s|S/m)\b", text), flag


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_defaults_are_shown_as_they_are_typed(name):
    for action, text in options(name).items():
        if callable(action.type) and action.default is not None:
            assert action.type(worded(action.default)) == action.default, action.option_strings[-1]
            assert f"default {worded(action.default)}" in text or "default:" in text, f"{name}: {text}"


def test_names_that_help_gives_are_those_that_there_are():
    told = {action.option_strings[-1]: action.type for action in options("evaluate")}
    assert set(told["--schemes"].known) == set(SCHEMES)
    told = {action.option_strings[-1]: action.type for action in options("rcs")}
    assert set(told["--unit"].known) == {AUTO, *UNITS_M}
    assert set(told["--up"].known) == set(told["--forward"].known) == {AUTO, *AXES}
    told = {action.option_strings[-1]: action.type for action in options("track")}
    assert set(told["--predictor"].known) == set(PREDICTORS)


def completed(shell, *words):
    script = f"""eval "$(cat script)"
COMP_WORDS=({" ".join(f"'{word}'" for word in words)}); COMP_CWORD={len(words) - 1}; _august; echo "${{COMPREPLY[@]}}"
"""
    run = subprocess.run([shell, "-c", script], capture_output=True, text=True, check=True)
    return run.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes_commands_options_choices_and_fields(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["--completion", "bash"]) == 0
    (tmp_path / "script").write_text(capsys.readouterr().out)
    assert completed("bash", "august", "de") == ["demo"]
    assert set(cli.COMMANDS) < set(completed("bash", "august", ""))
    assert completed("bash", "august", "demo", "--see") == ["--seed"]
    assert completed("bash", "august", "train", "--preset", "la") == ["laptop"]
    assert completed("bash", "august", "train", "--target", "") == ["networks", "predictor"]
    fields = completed("bash", "august", "train", "train.")
    assert set(fields) == {f"{each.path}=" for each in describe() if each.path.startswith("train.")}
    assert completed("bash", "august", "train", "dr") == []  # left to the shell: files


def test_zsh_reads_the_same_by_its_emulation_of_bash(capsys):
    scripts = []
    for shell in ("bash", "zsh"):
        assert cli.main(["--completion", shell]) == 0
        scripts.append(capsys.readouterr().out)
    bash, zsh = scripts
    assert zsh.endswith(bash) and "bashcompinit" in zsh.removesuffix(bash)


def test_another_shell_is_refused_with_those_that_there_are(capsys):
    assert cli.main(["--completion", "fish"]) == 2
    assert "'bash', 'zsh'" in capsys.readouterr().err
