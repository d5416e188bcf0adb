"""Configurations: presets, overrides, YAML, what is refused at the door, and what must go together."""

import dataclasses
import shlex
from typing import get_args

import pytest

from august_jax import config as configuration
from august_jax.app.cli import COMMANDS
from august_jax.app.cli.parser import parse
from august_jax.config import ConfigError, check_data, check_weights, override, preset, presets, schema, training_config


@pytest.mark.parametrize("name", configuration.PRESETS)
def test_yaml_round_trip(name):
    config = preset(name)
    assert config.preset == name
    assert configuration.from_yaml(configuration.to_yaml(config)) == config


@pytest.mark.parametrize("name", configuration.PRESETS)
def test_a_preset_states_commands_that_parse(name):
    record = configuration.PRESETS[name]
    assert record.summary and record.time and record.expected
    for line in record.command.split(" && "):
        program, *words = shlex.split(line)
        assert program == "august" and parse(words, COMMANDS) is not None


def test_paper_preset_holds_the_paper_s_numbers():
    paper = preset("paper")
    assert (paper.array.nx, paper.array.nz, paper.array.frequency_hz) == (16, 4, 3e9)
    assert paper.model.denoiser == (16, 64, 128, 256, 512, 1024, 512, 256, 128, 64, 16)
    assert (paper.model.latent, paper.model.steps, paper.model.beta) == (256, 200, (1e-4, 0.05))
    assert (paper.train.batch, paper.train.learning_rate, paper.train.points) == (256, (1e-4, 1e-5), 1000)
    assert paper.train.steps == 200 * 40_000 // 256
    assert (paper.flight.style, paper.flight.tilt_deg, paper.evaluate.sampler) == ("dynamic", 30.0, "ancestral")
    assert (paper.region.scale_m, paper.signal.power_dbm, paper.signal.noise_dbm) == (0.85, (10.0, 40.0), -120.0)


def test_overrides_are_applied_in_order_and_typed():
    config = override(preset("smoke"), ["train.steps=7", "train.learning_rate=[1e-3, 1e-4]", "train.steps=8"])
    assert config.train.steps == 8 and config.train.learning_rate == (1e-3, 1e-4)
    assert config.array == preset("smoke").array


REFUSED = {
    # no assignment, no such field
    "train.steps": "section.field=value",
    "train.stepz=3": "did you mean 'steps'",
    "steps=3": "unknown field",
    "preset=paper": "preset: 'paper' cannot be an override",
    # of another type
    "train.steps=many": "not an integer",
    "train.steps=2.5": "not an integer",
    "train.steps=": "no value is given",
    "train.steps=true": "not an integer",
    "train.steps=1e400": "not a finite number",
    "signal.noise_dbm=.nan": "not a finite number",
    "train.reobserve=1": "not true or false",
    "train.learning_rate=1e-3": "not a list",
    "train.learning_rate=[1e-3]": "2 wanted",
    "flight.box_m=[[5, 3], [4, 8]]": "3 wanted",
    "train.steps=[": "not YAML",
    "array.frequency_hz=011": "begins with a zero",
    "evaluate.snr_db=[3, 011]": "begins with a zero",
    "data.count=1:30": "base 60",
    "model.scheme=NoEBD": "model.scheme: unknown value 'NoEBD'; did you mean 'noebd'",
    # out of bounds
    "train.steps=-1": "must lie in 1 to",
    "array.nx=0": "must lie in 1 to 4096",
    "array.frequency_hz=1e15": r"must lie in 1000000 to 1e\+12 Hz",
    "array.tones_hz=[3e9, -3e9]": r"array.tones_hz\[1\]: -3e\+09 must lie in",
    "target.points=1000000000": "must lie in 1 to 1000000",
    "target.max_cells=1": "must lie in 8 to",
    "target.permittivity=[0.5, 2]": "must lie in 1 to 1000",
    "flight.slot_s=1e6": "must lie in 0.001 to 60 s",
    "flight.tilt_deg=90": "must lie in 0.01 to 89 degrees",
    "evaluate.snr_db=[1000]": "must lie in -100 to 100 dB",
    "signal.snr_db=[0, 300]": "must lie in -100 to 100 dB",
    "signal.beam_width_deg=[0, 0]": "must lie in 0.1 to 180 degrees",
    "train.learning_rate=[-1, 0]": "must lie in",
    "train.ema=1.5": "must lie in",
    "train.weight_position=-3": "must lie in 0 to",
    "data.seed=99999999999999999999": "must lie in 0 to 4294967295",
    "data.split=[8, -1, 1]": "must lie in 0 to",
    "model.denoiser=[16, 0]": r"model.denoiser\[1\]: 0 must lie in",
    "model.denoiser=[]": "at least one",
    "target.airframes=[]": "at least one",
    # not among the choices
    "model.encoder=big": "choose one of paper, roi",
    "signal.estimator=lmmse": "did you mean 'lmmse_roi'",
    "target.airframes=[quad_x, hexq]": r"target.airframes\[1\]: hexq .*did you mean 'hexa'",
    # not together
    "signal.snr_db=[30, 0]": "must not decrease",
    "flight.box_m=[[5, 3], [4, 8], [2, 5]]": r"flight.box_m\[0\]: \[5, 3\] must not decrease",
    "array.nx=4000 array.nz=5": "more than 16384 antennas",
    "train.points=100000": "must not exceed target.points",
    "signal.symbols=3": "one symbol an antenna",
    "target.skin_m=0.5": "must not exceed target.cell_m",
    "target.half_wheelbase_m=0.5": "set region.scale_m=1$",
    "target.permittivity=[1.5, 15]": "set region.permittivity_max=15$",
    "target.conductivity_s_m=[0.01, 2]": "set region.conductivity_max_s_m=2$",
    "target.permittivity=[1,1] target.conductivity_s_m=[0,0]": "target.permittivity: .*whose echo is zero",
    "train.reobserve=false": "data.observed: False .*set data.observed=true",
    "train.weight_readout=0": "set train.weight_readout above 0",
    "data.split=[0, 1, 1]": "share for training",
    "evaluate.sampler_steps=1": "between 2 and model.steps",
}


@pytest.mark.parametrize("text", REFUSED)
def test_bad_overrides_name_the_field_and_the_way_out(text):
    words = text.split(" ") if text.count("=") > 1 else [text]
    with pytest.raises(ConfigError, match=REFUSED[text]) as refused:
        override(preset("laptop"), words)
    assert words[0].split("=")[0].split(".")[0] in str(refused.value) and "--" not in str(refused.value)


def test_python_meets_the_same_door(unchecked):
    with pytest.raises(ConfigError, match="array.frequency_hz: 0 must lie in"):
        configuration.ArrayConfig(frequency_hz=0.0)
    with pytest.raises(ConfigError, match="signal.estimator: unknown value 'mmse'"):
        configuration.SignalConfig(estimator="mmse")
    with pytest.raises(ConfigError, match="whose echo is zero"):
        configuration.Config(target=configuration.TargetConfig(permittivity=(1.0, 1.0), conductivity_s_m=(0.0, 0.0)))
    # lists and whole numbers become what the field holds: equal, and fit to be a static argument
    listed = configuration.ArrayConfig(tones_hz=[3_000_000_000])
    assert listed == configuration.ArrayConfig(tones_hz=(3e9,)) and hash(listed)


def test_mesh_files_are_looked_for_where_they_are_read():
    config = override(preset("smoke"), ['target.airframes=[quad_x, "drone.stl?unit=mm&up=y"]'])
    assert config.target.airframes[1] == "drone.stl?unit=mm&up=y"
    with pytest.raises(ConfigError, match="double quotes"):
        override(preset("smoke"), ["target.airframes=[quad_x, drone.stl?unit=mm&up=y]"])


def test_choices_are_those_of_the_code():
    from august_jax.physics.channel import SOLVERS
    from august_jax.scene import AIRFRAMES
    from august_jax.signal import ESTIMATORS
    from august_jax.signal.beams import PILOTS

    assert set(get_args(configuration.Family)) == set(AIRFRAMES)
    assert set(get_args(configuration.Solver)) == {*SOLVERS, "table"}
    assert set(get_args(configuration.EstimatorName)) == set(ESTIMATORS)
    assert set(get_args(configuration.Pilots)) == set(PILOTS)


def test_every_field_is_described():
    fields = {field.path: field for field in configuration.describe()}
    assert set(fields) == set(configuration.leaves(configuration.Config()))
    for path, field in fields.items():
        assert field.doc, path
        numbers = "number" in field.type
        assert (field.bounds is not None) == numbers, path
        # whoever holds metres, hertz, ... says so in the name or among the bounds' units
        suffix = path.rsplit("_", 1)[-1]
        if suffix in ("hz", "m", "s", "deg", "db", "dbm"):
            assert field.unit, path
    assert fields["signal.estimator"].type == " | ".join(get_args(schema.EstimatorName))
    assert fields["array.frequency_hz"][2:5] == (3e9, (1e6, 1e12), "Hz")


def test_the_digest_of_data_follows_the_physics_and_not_the_amount():
    config = preset("smoke")
    identity = configuration.data_digest
    assert identity(override(config, ["data.count=99"])) == identity(config)
    assert identity(override(config, ["target.skin_m=0.001"])) != identity(config)
    # what the base station made of a sample is part of it where it is kept
    for estimator in ("ls", "dft"):
        seen = override(config, ["data.observed=true", f"signal.estimator={estimator}"])
        assert identity(seen) != identity(override(config, ["data.observed=true"]))
        assert identity(override(config, [f"signal.estimator={estimator}"])) == identity(config)


DATA = override(preset("smoke"), ["data.seed=3", "data.count=40"])


def test_training_takes_from_the_data_what_they_are_made_of():
    config = training_config(DATA, ["train.steps=4"])
    assert (config.data, config.train.steps) == (DATA.data, 4)
    assert config.model == preset("smoke").model
    # observed anew in every step: the estimator is the training's to choose
    assert training_config(DATA, ["signal.estimator=ls"]).signal.estimator == "ls"


@pytest.mark.parametrize(
    "changes, assignments",
    [
        (["target.points=12", "train.points=8"], ["train.points=12"]),
        (["data.observed=false", "train.reobserve=true"], ["train.reobserve=true"]),
    ],
)
def test_training_may_give_what_its_data_ask_for(changes, assignments, monkeypatch):
    """The preset's own training does not fit these data; with what is assigned it does."""
    stored = override(preset("smoke"), ["data.observed=true", "train.reobserve=false"])
    other = dataclasses.replace(presets.PRESETS["smoke"], build=lambda: stored)
    monkeypatch.setitem(presets.PRESETS, "smoke", other)
    config = training_config(override(stored, changes), assignments)
    assert config.train.points <= config.target.points and (config.data.observed or config.train.reobserve)
    with pytest.raises(ConfigError, match=assignments[0].partition("=")[0]):
        training_config(override(stored, changes))


@pytest.mark.parametrize(
    ("name", "assignments", "message"),
    [
        ("laptop", [], "preset: 'laptop', but D was made with preset 'smoke'"),
        ("huge", [], "preset: unknown preset 'huge'"),
        (None, ["array.nx=8"], "array.nx: 8, but D was made with 4"),
        (None, ["data.seed=4"], "data.seed: 4, but D was made with 3"),
    ],
)
def test_training_is_refused_what_the_data_are_not(name, assignments, message):
    with pytest.raises(ConfigError, match=message):
        training_config(DATA, assignments, name=name, data="D")


def test_stored_observations_fix_how_they_were_made():
    made = override(DATA, ["data.observed=true"])
    config = override(made, ["train.reobserve=false"])
    check_data(config, made)
    with pytest.raises(ConfigError, match="signal.estimator: ls, but the data was made with lmmse_roi"):
        check_data(override(config, ["signal.estimator=ls"]), made)


@pytest.mark.parametrize(
    "assignment", ["array.nx=8", "model.latent=4", "region.scale_m=0.8", "flight.box_m=[[3,7],[4,8],[2,6]]"]
)
def test_weights_fit_what_they_were_trained_for(assignment):
    trained = preset("smoke")
    check_weights(override(trained, ["signal.estimator=ls", "evaluate.sampler_steps=3", "flight.slots=2"]), trained)
    with pytest.raises(ConfigError, match=f"{assignment.split('=')[0]}: .*trained with"):
        check_weights(override(trained, [assignment]), trained)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("a: [", "not YAML"),
        ("3", "no mapping"),
        ("model: {latnet: 3}", "model.latnet: unknown field; did you mean 'latent'"),
        ("modle: {latent: 3}", "modle: unknown field; did you mean 'model'"),
        ("model: 3", "model: 3 is not a section"),
        ("preset: huge", "preset: unknown value 'huge'"),
        ("array:\n  nx: 4\n  nx: 8", "nx is given twice"),
        ("array: {nx: 04}", "04 begins with a zero"),
        ("\xff", "utf-8"),
    ],
)
def test_a_damaged_or_edited_file_is_named(tmp_path, text, wanted):
    path = tmp_path / "config.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match="config.yaml.*\n.*make that folder again") as refused:
        configuration.read(path)
    assert wanted in str(refused.value)


@pytest.mark.parametrize("kind", ["flip", "cut"])
def test_damage_that_leaves_a_valid_file_is_noticed(tmp_path, kind):
    """A digit that became another one, and a file that ends where a line does: what is missing takes its default."""
    path, config = tmp_path / "config.yaml", preset("smoke")
    path.write_text(configuration.to_summed_yaml(config))
    assert configuration.read(path) == config == configuration.from_yaml(path.read_text())
    text = path.read_text()
    damaged = {"flip": text.replace("steps: 20", "steps: 21"), "cut": text[: text.index("evaluate:")]}[kind]
    assert configuration.from_yaml(damaged) != config  # valid all the same
    path.write_text(damaged)
    with pytest.raises(ConfigError, match=r"config.yaml: .*check sum of other lines; if you changed these, remove it"):
        configuration.read(path)
    path.write_text(damaged.partition("\n")[2])  # as told to who changed it
    assert configuration.read(path) == configuration.from_yaml(damaged)


def test_configurations_are_values():
    config = preset("smoke")
    assert dataclasses.replace(config) == config and hash(dataclasses.replace(config)) == hash(config)
