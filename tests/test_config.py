"""Configurations: presets, overrides, YAML, and what is refused."""

import dataclasses

import pytest

from august_jax import config as configuration
from august_jax.config import ConfigError, override, preset


@pytest.mark.parametrize("name", configuration.PRESETS)
def test_yaml_round_trip(name):
    config = preset(name)
    assert configuration.from_yaml(configuration.to_yaml(config)) == config


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


@pytest.mark.parametrize(("text", "message"), [
    ("train.steps", "section.field=value"),
    ("train.stepz=3", "did you mean 'steps'"),
    ("train.steps=many", "not an integer"),
    ("train.steps=2.5", "not an integer"),
    ("train.steps=-1", "positive"),
    ("train.learning_rate=1e-3", "not a list"),
    ("train.learning_rate=[1e-3]", "2 wanted"),
    ("model.encoder=big", "choose one of paper, roi"),
    ("signal.snr_db=[30, 0]", "must not decrease"),
    ("flight.box_m=[[5, 3], [4, 8], [2, 5]]", "must not decrease"),
    ("target.airframes=[]", "at least one airframe"),
    ("train.points=100000", "must not exceed target.points"),
    ("signal.symbols=3", "one symbol an antenna"),
    ("target.skin_m=0.5", "must not exceed target.cell_m"),
    ("target.half_wheelbase_m=0.5", "set region.scale_m=1$"),
    ("target.permittivity=[1.5, 15]", "set region.permittivity_max=15$"),
    ("target.conductivity_s_m=[0.01, 2]", "set region.conductivity_max_s_m=2$"),
    ("signal.noise_dbm=.nan", "not a finite number"),
    ("evaluate.snr_db=[1000]", "within 100 dB"),
    ("signal.snr_db=[0, 300]", "within 100 dB"),
    ("train.learning_rate=[-1, 0]", "must be positive"),
    ("train.ema=1.5", "must lie in"),
    ("train.weight_position=-3", "must not be negative"),
    ("signal.beam_width_deg=[0, 0]", "must lie in"),
    ("data.seed=99999999999999999999", "less than 2^31"),
    ("preset=paper", "with --preset"),
    ("steps=3", "unknown field"),
])
def test_bad_overrides_name_the_field_and_the_way_out(text, message):
    with pytest.raises(ConfigError, match=message.replace("[", r"\[").replace("^", r"\^")):
        override(preset("laptop"), [text])


def test_the_digest_of_data_follows_the_physics_and_not_the_amount():
    config = preset("smoke")
    same = dataclasses.replace(config, data=dataclasses.replace(config.data, count=99))
    other = override(config, ["target.skin_m=0.001"])
    assert configuration.data_digest(config) == configuration.data_digest(same)
    assert configuration.data_digest(config) != configuration.data_digest(other)
    with pytest.raises(ConfigError, match="unknown preset"):
        preset("huge")


@pytest.mark.parametrize("text", ["a: [", "3", "model: {latnet: 3}", "preset: huge", "\xff"])
def test_a_damaged_file_is_named(tmp_path, text):
    path = tmp_path / "config.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(configuration.ConfigError, match="config.yaml.*\n.*make that folder again"):
        configuration.read(path)
