"""Bad input at the command line: exit status 2 and a few lines that name the field, the value and the way out."""

import shlex

import pytest

from august_jax.app import cli
from august_jax.app.cli.messages import command_line, in_flags, told
from august_jax.app.cli.parser import parse

CASES = {
    "no such command": ("demmo", ["'demmo'", "did you mean 'demo'"]),
    "unknown option": ("demo --sed 3", ["--sed", "did you mean --seed", "august demo --help"]),
    "option of another command": ("simulate --run X", ["'--run'", "section.field=value"]),
    "stray word": ("demo quickly", ["'quickly'", "section.field=value"]),
    "run given twice": ("evaluate one --run two", ["'one'", "--run two"]),
    "bad number": ("demo --snr loud", ["--snr", "'loud'", "is not a number"]),
    "infinite number": ("demo --snr inf", ["--snr", "'inf'"]),
    "SNR beyond single precision": ("demo --snr 300", ["--snr", "300", "-100 to 100 dB"]),
    "huge angle": ("reconstruct --mesh a.ply --yaw 1e308", ["--yaw", "1e308", "-360 to 360 degrees"]),
    "huge place": ("reconstruct --mesh a.ply --position 1e30,5,3", ["--position", "-10000 to 10000 m"]),
    "negative size": ("reconstruct --mesh a.ply --half-wheelbase -1", ["--half-wheelbase", "-1", "0.01 to 50 m"]),
    "material below that of air": ("reconstruct --mesh a.ply --permittivity 0.5", ["--permittivity", "1 to 1000"]),
    "no slots": ("demo --slots 0", ["--slots", "'0'", "from 1 to"]),
    "huge flight": ("demo --slots 1000000000", ["--slots", "from 1 to 100000"]),
    "huge seed": ("demo --seed 99999999999999999999", ["--seed", "2147483647"]),
    "unknown style of flight": ("track --style loops", ["--style", "'loops'", "smooth", "dynamic", "jump"]),
    "flight too short to follow": ("track --preset smoke --slots 3", ["--slots", "'3'", "from 4 to 100000"]),
    "unknown scheme to follow": ("track --scheme agust", ["--scheme: 'agust' is no scheme", "did you mean 'august'?"]),
    "scheme without a place": (
        "track --scheme up",
        ["--scheme: 'up' says of no place", "august, matched_field, polar"],
    ),
    "unknown predictor": (
        "track --preset smoke --scheme polar --predictor kalmann",
        ["--predictor: unknown predictor 'kalmann'", "did you mean 'kalman'?"],
    ),
    "predictor that is not asked": ("track --predictor kalman", ["--predictor: matched_field", "leave it out"]),
    "run that is not asked": ("track --scheme polar --run one", ["--run: polar asks no networks", "--scheme august"]),
    "no such run to follow": ("track --scheme august --run {tmp}/nowhere", ["{tmp}/nowhere", "august train"]),
    "flight too short for a loop": (
        "track --preset smoke --scheme polar --slots 3",
        ["--slots", "'3'", "from 4 to 100000"],
    ),
    "predictor of other slots": (
        "track --preset smoke --scheme polar flight.slot_s=0.1",
        ["flight.slot_s: 0.1 s", "another predictor", "august train"],
    ),
    "unknown craft to follow": ("track --airframe quadx", ["quadx", "quad_plus", "mesh file"]),
    "library with a craft twice": ("track --preset smoke target.airframes=[quad_x,quad_x]", ["quad_x", "twice"]),
    "odd digit": ("demo --seed \u00b2", ["--seed", "whole number"]),
    "negative seed": ("demo --seed -1", ["--seed", "'-1'", "from 0 to"]),
    "index that is none": ("export somewhere --format ply --index 1.5", ["--index", "'1.5'", "whole number"]),
    "empty preset": ("simulate --preset=", ["--preset", "'' is empty"]),
    "empty folder": ("simulate --preset smoke --out=", ["--out", "'' is empty"]),
    "empty run": ("demo --run=", ["--run", "'' is empty"]),
    "empty value": ("simulate --preset smoke data.count=", ["data.count", "no value is given"]),
    "unknown preset of weights": ("demo --preset huge", ["--preset", "'huge'", "smoke, laptop, paper"]),
    "preset as an override": ("simulate --preset smoke preset=paper", ["--preset: 'paper'", "override"]),
    "bad triple": ("reconstruct --mesh a.ply --position 1,2", ["--position", "'1,2'", "x,y,z", "5,6,3.5"]),
    "mesh not given": ("reconstruct", ["--mesh"]),
    "bad part": ("simulate --shard 5/4", ["--shard", "'5/4'", "1/4"]),
    "format not given": ("export somewhere", ["--format"]),
    "nothing to override": ("export somewhere --format ply train.steps=3", ["train.steps=3", "august export --help"]),
    "sampler steps": ("simulate --preset smoke evaluate.sampler_steps=1", ["evaluate.sampler_steps", "between 2 and"]),
    "out is a file": ("simulate --preset smoke --out {tmp}/../occupied", ["--out", "is a file", "another folder"]),
    "unknown preset": ("simulate --preset huge", ["--preset", "'huge'", "smoke, laptop, paper"]),
    "unknown section": ("simulate --preset smoke trian.steps=3", ["'trian'", "did you mean 'train'"]),
    "unknown field": ("train --preset smoke train.stesp=3", ["train.stesp", "did you mean 'steps'"]),
    "bad value": ("simulate --preset smoke data.count=many", ["data.count", "'many'", "integer"]),
    "value out of bounds": ("simulate --preset smoke array.nx=0", ["array.nx", "0", "1 to 4096"]),
    "a milliard of points": ("simulate --preset smoke target.points=1000000000", ["target.points", "1 to 1000000"]),
    "slots of eleven days": ("simulate --preset smoke flight.slot_s=1e6", ["flight.slot_s", "60 s"]),
    "frequency of X-rays": ("simulate --preset smoke array.frequency_hz=1e15", ["array.frequency_hz", "1e+12 Hz"]),
    "leading zero": ("simulate --preset smoke array.frequency_hz=011", ["array.frequency_hz", "011", "octal"]),
    "craft of one cell": ("simulate --preset smoke target.max_cells=1", ["target.max_cells", "8 to"]),
    "craft of air": (
        "simulate --preset smoke target.permittivity=[1,1] target.conductivity_s_m=[0,0]",
        ["target.permittivity", "target.conductivity_s_m", "echo is zero"],
    ),
    "bad choice": ("simulate --preset smoke data.solver=magic", ["data.solver", "'magic'", "mom, table, krylov"]),
    "bad list": ("simulate --preset smoke evaluate.snr_db=20", ["evaluate.snr_db", "[a,b]"]),
    "no such airframe": ("simulate --preset smoke target.airframes=[quadx]", ["quadx", "did you mean 'quad_x'"]),
    "typo in a list": (
        "simulate --preset smoke target.airframes=[quad_x,hexq]",
        ["target.airframes[1]", "hexq", "did you mean 'hexa'"],
    ),
    "observations that are not kept": (
        "simulate --preset smoke train.reobserve=false",
        ["data.observed", "data.observed=true"],
    ),
    "no such run": ("evaluate {tmp}/nowhere", ["{tmp}/nowhere", "august train"]),
    "nobody to ask": (
        "evaluate --schemes matched_field evaluate.searched=0",
        ["--schemes: matched_field leaves nobody to ask", "evaluate.searched=0", "a search wants some slots"],
    ),
    "unknown scheme in a plan": ("evaluate --dry-run --schemes foo", ["--schemes: unknown scheme 'foo'", "choose of"]),
    "unknown scheme": ("evaluate --schemes august,polr", ["--schemes: unknown scheme 'polr'", "did you mean 'polar'?"]),
    "no such run beside another": ("evaluate {tmp}/nowhere {tmp}/neither", ["{tmp}/nowhere", "august train"]),
    "no such run, as an option": ("evaluate --run {tmp}/nowhere", ["{tmp}/nowhere", "august train"]),
    "no such run for demo": ("demo --run {tmp}/nowhere", ["{tmp}/nowhere", "august train"]),
    "no such data": ("train --preset smoke --data {tmp}/nowhere", ["{tmp}/nowhere", "august simulate"]),
    "no such data for the default": (
        "train",
        ["august_data/laptop", "august simulate --preset laptop --out", "train.source=stream"],
    ),
    "data for a stream": (
        "train --preset smoke --data {tmp}/here train.source=stream",
        ["--data", "{tmp}/here", "train.source=stream", "leave --data out"],
    ),
    "data for a stream, planned": (
        "train --preset smoke --dry-run --data {tmp}/here train.source=stream",
        ["--data", "{tmp}/here", "leave --data out"],
    ),
    "no weights to start from": (
        "train --preset smoke train.source=stream --init {tmp}/nowhere",
        ["--init: {tmp}/nowh"],
    ),
    "no weights to start from, planned": (
        "train --preset smoke train.source=stream --init {tmp}/nowhere --dry-run",
        ["--init: {tmp}/nowhere", "august train"],
    ),
    "half of several hosts, planned": (
        "train --preset smoke --dry-run --coordinator here:1234",
        ["--host: is missing", "--coordinator ADDRESS:PORT"],
    ),
    "an SNR twice": ("evaluate evaluate.snr_db=[20,10,20]", ["evaluate.snr_db", "20.0 twice", "each once"]),
    "known drones that nobody searches": ("demo --search 0 --known=3", ["--known", "leave it out", "--search N"]),
    "data for a predictor": (
        "train --target predictor --preset smoke --data {tmp}/here",
        ["--data", "{tmp}/here", "flights", "leave --data out"],
    ),
    "no such target": ("train --target predictors", ["--target", "'predictors'", "networks", "predictor"]),
    "no predictor to start from": (
        "train --target predictor --preset smoke --init {tmp}/nowhere",
        ["--init", "{tmp}/nowhere/predictor.npz", "august train --target predictor", "shipped"],
    ),
    "a stream that is not observed anew": (
        "train --preset smoke train.source=stream train.reobserve=false data.observed=true",
        ["train.source", "stream", "train.reobserve=true"],
    ),
    "a stream by a solver without tables": (
        "train --preset smoke train.source=stream data.solver=born",
        ["data.solver", "born", "mom or table"],
    ),
    "no such source": ("export {tmp}/nowhere --format ply", ["{tmp}/nowhere", "august demo"]),
    "unknown format": ("export {tmp} --format docx", ["--format", "'docx'", "ply, csv, npz, mat, json"]),
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
        # long paths break lines elsewhere on every machine
        assert text.format(tmp=tmp_path) in err or text.format(tmp=tmp_path) in " ".join(err.split())
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


@pytest.mark.parametrize(
    "words", [[], ["--help"], ["demo", "--help"], ["reconstruct", "-h"], ["track", "--help"], ["--version"]]
)
def test_help_goes_to_stdout(capsys, words):
    status, out, err = run(capsys, words)
    assert (status, err) == (0, "")
    assert "august" in out


def test_values_that_begin_with_a_minus_sign():
    args = parse("reconstruct --mesh a.stl --up -z --forward -y --position -1,4,2 --yaw -30".split(), cli.COMMANDS)
    assert (args.up, args.forward, args.position, args.yaw) == ("-z", "-y", (-1.0, 4.0, 2.0), -30.0)


def test_a_folder_with_an_equals_sign_is_no_override(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lr=3e-4").mkdir()
    args = parse(["evaluate", "lr=3e-4", "evaluate.count=2"], cli.COMMANDS)
    assert (args.rest, args.overrides) == (["lr=3e-4"], ["evaluate.count=2"])
    assert parse(["export", "lr=3e-4", "--format", "mat"], cli.COMMANDS).rest == ["lr=3e-4"]
    assert parse(["evaluate", "lr=4e-4"], cli.COMMANDS).overrides == ["lr=4e-4"]  # which the configuration refuses


def test_a_command_that_is_advised_stays_on_its_line():
    folder = "/scratch/" + "second-attempt/" * 14 + "august-data"
    advice = f"make them: august simulate --preset smoke --out {folder}"
    assert told(ValueError(f"--data: holds no data\n{advice}")).splitlines()[1:] == [advice]
    prose = "word-of-many-parts " * 12
    assert all(word == "word-of-many-parts" for word in told(ValueError(prose)).split()[1:])


def test_overrides_mix_with_options():
    args = parse("train train.steps=5 --data here model.latent=3 --out there".split(), cli.COMMANDS)
    assert args.overrides == ["train.steps=5", "model.latent=3"]
    assert (args.data, args.out) == ("here", "there")


OPTIONS = ("--position", "--snr", "--half-wheelbase", "--unit", "--pitch", "--roll")


@pytest.mark.parametrize(
    ("message", "wanted"),
    [
        ("snr_db: 300 dB is too much", "--snr: 300 dB is too much"),
        ("pitch_deg, roll_deg: 50 and 3", "--pitch, --roll: 50 and 3"),
        ("unit='furlong': choose one of m, cm", "--unit 'furlong': choose one of m, cm"),
        ("position: outside; choose position=(5.0, 6.0, 3.5)", "--position: outside; choose --position 5.0,6.0,3.5"),
        (
            "half_wheelbase_m: 2; set half_wheelbase_m=0.25, or check unit",
            "--half-wheelbase: 2; set --half-wheelbase 0.25, or check unit",
        ),
        # not the option's business: fields, paths, arguments that this command has no option for
        ("data.seed: 3; set data.seed=4", "data.seed: 3; set data.seed=4"),
        ("/tmp/unit=3/file: damaged", "/tmp/unit=3/file: damaged"),
        ("seed: 3; set seed=4", "seed: 3; set seed=4"),
    ],
)
def test_arguments_of_the_library_become_options(message, wanted):
    assert in_flags(message, OPTIONS) == wanted


def test_lines_to_repeat_are_quoted():
    words = ["reconstruct", "--mesh", "my drones/it's one.stl", "--position", "-1,4,2"]
    program, *back = shlex.split(command_line(*words))
    assert (program, back) == ("august", words)
