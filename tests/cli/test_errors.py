"""Bad input at the command line: exit status 2 and a few lines that name the field, the value and the way out."""

import pytest

from august_jax.app import cli
from august_jax.app.cli.parser import parse

CASES = {
    "no such command": ("demmo", ["'demmo'", "did you mean 'demo'"]),
    "unknown option": ("demo --sed 3", ["--sed", "did you mean --seed", "august demo --help"]),
    "stray word": ("demo quickly", ["'quickly'", "section.field=value"]),
    "bad number": ("demo --snr loud", ["--snr", "'loud'", "is not a number"]),
    "infinite number": ("demo --snr inf", ["--snr", "'inf'"]),
    "huge seed": ("demo --seed 99999999999999999999", ["--seed", "2^31"]),
    "odd digit": ("demo --seed \u00b2", ["--seed", "whole number"]),
    "unknown preset of weights": ("demo --preset huge", ["preset", "'huge'", "smoke, laptop, paper"]),
    "preset as an override": ("simulate --preset smoke preset=paper", ["preset=paper", "--preset"]),
    "negative seed": ("demo --seed -1", ["--seed", "'-1'", "from 0 up"]),
    "bad triple": ("reconstruct --mesh a.ply --position 1,2", ["--position", "'1,2'", "x,y,z", "5,6,3.5"]),
    "mesh not given": ("reconstruct", ["--mesh"]),
    "bad part": ("simulate --shard 5/4", ["--shard", "'5/4'", "1/4"]),
    "format not given": ("export somewhere", ["--format"]),
    "nothing to override": ("export somewhere --format ply train.steps=3", ["train.steps=3", "august export --help"]),
    "sampler steps": ("simulate --preset smoke evaluate.sampler_steps=1", ["evaluate.sampler_steps", "between 2 and"]),
    "out is a file": ("simulate --preset smoke --out {tmp}/../occupied", ["--out", "is a file", "another folder"]),
    "unknown preset": ("simulate --preset huge", ["preset", "'huge'", "smoke, laptop, paper"]),
    "unknown section": ("simulate --preset smoke trian.steps=3", ["'trian'", "did you mean 'train'"]),
    "unknown field": ("train --preset smoke train.stesp=3", ["train.stesp", "did you mean 'steps'"]),
    "bad value": ("simulate --preset smoke data.count=many", ["data.count", "'many'", "integer"]),
    "value out of range": ("simulate --preset smoke array.nx=0", ["array.nx", "0", "positive"]),
    "bad choice": ("simulate --preset smoke data.solver=magic", ["data.solver", "'magic'", "mom, krylov"]),
    "bad list": ("simulate --preset smoke evaluate.snr_db=20", ["evaluate.snr_db", "[a,b]"]),
    "no such airframe": ("simulate --preset smoke target.airframes=[quadx]", ["'quadx'", "quad_x"]),
    "no such run": ("evaluate {tmp}/nowhere", ["{tmp}/nowhere", "august train"]),
    "no such run for demo": ("demo --run {tmp}/nowhere", ["{tmp}/nowhere", "august train"]),
    "no such data": ("train --preset smoke --data {tmp}/nowhere", ["{tmp}/nowhere", "august simulate"]),
    "no such data for the default": ("train", ["august_data/laptop", "august simulate --preset laptop --out"]),
    "no such source": ("export {tmp}/nowhere --format ply", ["{tmp}/nowhere", "august demo"]),
    "unknown format": ("export {tmp} --format docx", ["--format", "'docx'", "ply, npz, mat, json"]),
}


def run(capsys, words):
    """Exit status, stdout and stderr of one command, run in this process."""
    status = cli.main(words)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_refused_helpfully(capsys, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "../occupied").touch()
    line, wanted = CASES[name]
    status, out, err = run(capsys, line.format(tmp=tmp_path).split())
    assert status == 2
    assert out == ""
    assert 1 <= len(err.strip().splitlines()) <= 6, err
    assert "Traceback" not in err
    for text in wanted:
        assert text.format(tmp=tmp_path) in err
    assert not list(tmp_path.iterdir())


def test_unforeseen_errors_are_short_too(capsys, monkeypatch):
    def fail(args):
        raise TypeError("\n".join(f"line {number} of a long message" for number in range(40)))

    monkeypatch.setitem(cli.COMMANDS, "doctor", cli.COMMANDS["doctor"]._replace(run=fail))
    status, _, err = run(capsys, ["doctor"])
    assert status == 2
    assert "TypeError" in err and len(err.strip().splitlines()) <= 6
    with pytest.raises(TypeError):
        cli.main(["doctor", "--debug"])


def test_interrupt_is_told_in_one_line(capsys, monkeypatch):
    def interrupt(args):
        raise KeyboardInterrupt

    monkeypatch.setitem(cli.COMMANDS, "doctor", cli.COMMANDS["doctor"]._replace(run=interrupt))
    status, out, err = run(capsys, ["doctor"])
    assert (status, out, len(err.splitlines())) == (130, "", 1)


@pytest.mark.parametrize("words", [[], ["--help"], ["demo", "--help"], ["reconstruct", "-h"], ["--version"]])
def test_help_goes_to_stdout(capsys, words):
    status, out, err = run(capsys, words)
    assert (status, err) == (0, "")
    assert "august" in out


def test_values_that_begin_with_a_minus_sign():
    args = parse("reconstruct --mesh a.stl --up -z --forward -y --position -1,4,2 --yaw -30".split(), cli.COMMANDS)
    assert (args.up, args.forward, args.position, args.yaw) == ("-z", "-y", (-1.0, 4.0, 2.0), -30.0)


def test_overrides_mix_with_options():
    args = parse("train train.steps=5 --data here model.latent=3 --out there".split(), cli.COMMANDS)
    assert args.overrides == ["train.steps=5", "model.latent=3"]
    assert (args.data, args.out) == ("here", "there")
