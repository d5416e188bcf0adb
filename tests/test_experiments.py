"""Each study can be computed small and drawn, its numbers obey a law of its own, and damaged ones are refused."""

from __future__ import annotations

import numpy as np
import pytest
import scripts
from matplotlib.image import imread

STORED = scripts.ROOT / "experiments" / "results"
STUDIES = scripts.defining("experiments", "compute", "draw")


def cell_size(numbers):
    """Finer lattices come nearer to the finest, and one complex factor can only bring a channel nearer."""
    plain, shaped = numbers["difference"], numbers["but_for_a_gain"]
    sizes, permittivities = numbers["sizes_mm"], numbers["permittivities"]
    assert plain.shape == shaped.shape == (2, len(sizes), len(permittivities))
    assert np.all(np.diff(numbers["cells"]) > 0) and np.all(np.diff(sizes) < 0)
    assert np.all(shaped <= plain + 1e-6)
    assert np.all(np.diff(plain[0], axis=0) < 0.0) and np.all(plain[0, -1] == 0.0)  # fields at the material's centroids
    assert (
        np.ptp(numbers["material_m3"]) < 0.03 * numbers["material_m3"].mean()
    )  # the skin's own volume on every lattice


def array_design(numbers):
    """The descent ends below where it began and below what it began from; a channel is most like itself."""
    names, bounds, likeness = list(numbers["names"]), numbers["bounds_m"], numbers["likeness"]
    here = len(numbers["shifts_m"]) // 2
    assert numbers["places_m"].shape == (len(names), 16, 2) and likeness.shape == (len(names), 2, 2 * here + 1)
    assert numbers["course_m"][-1] < 0.8 * numbers["course_m"][0]
    assert np.all(bounds > 0.0) and names[np.argmin(bounds)] == "descended"
    assert np.abs(numbers["places_m"]).max() <= 0.4 + 1e-6  # the aperture
    assert np.all((likeness >= 0.0) & (likeness < 1.0 + 1e-5))  # Cauchy and Schwarz
    assert np.allclose(likeness[..., here], 1.0, atol=1e-5)


def what_physics_allows(numbers):
    """Bounds fall with the SNR and with antennas, rise with range, and never exceed what is known beforehand."""
    from august_jax.physics.information import Spread

    cases, position, tilt = list(numbers["cases"]), numbers["position_m"], numbers["tilt_deg"]
    assert position.shape == tilt.shape == (len(cases), len(numbers["ranges_m"]), len(numbers["snrs_db"]))
    for bound in (position, tilt):
        assert np.all(bound > 0.0) and np.all(np.diff(bound, axis=-1) <= 1e-6 * bound[..., 1:])
    assert position.max() <= np.sqrt(3.0) * Spread().position_m
    assert tilt.max() <= np.sqrt(2.0) * np.rad2deg(Spread().turn_rad)
    at20 = position[:, :, int(np.argmin(np.abs(numbers["snrs_db"] - 20.0)))]
    assert np.all(np.diff(at20, axis=1) > 0.0)
    larger = at20[[cases.index(f"{size}, 1 tone") for size in ("16x1", "16x2", "16x4", "16x16")]]
    assert np.all(np.diff(larger, axis=0) < 0.0)
    for name in ("searched_m", "searched_deg"):  # (slot, SNR, expected, true, bound)
        values = numbers[name]
        assert values.shape[1:] == (len(numbers["searched_db"]), 3) and np.all(values >= 0.0)
        assert np.all(np.diff(values[..., 2], axis=1) < 0.0)
    expected = np.mean(numbers["searched_m"][..., 0], axis=0)
    assert expected[-1] < 0.8 * expected[0]  # the louder the echo, the surer the posterior


def echo_over_the_box(numbers):
    """Skins are thin against the wavelength: a field scattered by the volume, 20 dB a tenfold of material."""
    snr, material = numbers["snr_db"], numbers["material_m3"]
    assert snr.shape[:2] == material.shape == (len(numbers["skins_m"]), len(numbers["airframes"]))
    stronger = np.median(snr[1] - snr[0], axis=-1)
    # 1.5 dB: cells that couple turn the pattern; over 200 flights of five craft the median stays within 0.2 dB
    assert np.allclose(stronger, 20.0 * np.log10(material[1] / material[0]), atol=1.5)


def pose_by_gradients(numbers):
    """A known gain's valleys repeat every half wavelength, 5 cm; a fitted gain leaves one, and never fits worse."""
    known, fitted = numbers["valleys"]
    offsets, ends = numbers["offsets_m"], np.linalg.norm(numbers["ends"][..., :3], axis=-1)

    def floors(misfit):
        return offsets[1:-1][(misfit[1:-1] < misfit[:-2]) & (misfit[1:-1] < misfit[2:])]

    step = offsets[1] - offsets[0]
    assert len(floors(known)) >= 5 and np.allclose(np.diff(floors(known)), 0.05, atol=1.01 * step)
    assert len(floors(fitted)) == 1 and abs(floors(fitted)[0]) < 1.01 * step
    assert np.all(fitted <= known + 1e-6)
    assert np.all(np.diff(numbers["paths"], axis=-1) <= 1e-6)  # a step that fits worse is not taken
    near = numbers["starts_m"] < 0.015
    assert np.all(ends[:, near] < 3.0 * numbers["bound_m"])


def trust(numbers):
    """Levels are shares, errors are those of the places told, and about the truth there is noise alone."""
    same = numbers["world"] == "same"
    assert same.any() and len(set(zip(numbers["world"], numbers["slot"], numbers["snr_db"]))) == len(same)
    levels = [name for name in numbers if name.endswith("_level") or name.startswith("rank_")]
    assert len(levels) == 11 and all(np.all((numbers[name] >= 0.0) & (numbers[name] <= 1.0)) for name in levels)
    apart = np.linalg.norm(numbers["estimate"] - numbers["position"], axis=-1)
    assert np.allclose(apart, numbers["error_m"], atol=1e-6)
    assert np.all((numbers["normal_error"] > -1e-6) & (numbers["effective"] >= 1.0 - 1e-6))
    assert np.all(numbers["heading_by_arms_deg"] <= numbers["heading_error_deg"] + 1e-3)
    loudest = same & (numbers["snr_db"] == numbers["snr_db"].max())
    assert np.mean(numbers["error_m"][loudest]) < np.mean(numbers["prediction_error_m"][loudest])
    assert np.mean(numbers["searched"][loudest]) > 0.6 and np.mean(numbers["explained"][loudest]) > 0.6
    half = numbers["degrees"][loudest] / 2.0  # of a chi-square's mean, which is its variance, too, for |N|^2
    assert np.all(np.abs(numbers["start_residual"][loudest] - half) < 5.0 * np.sqrt(half))


def parts_of_a_drone(numbers):
    """Shares sum to one, and a part's removal changes H by no more than its cells' derivatives add up to."""
    cells, part, parts = numbers["cells"], numbers["part"], numbers["parts"]
    assert numbers["positions"].shape == (len(cells), 3) and part.shape == cells.shape
    assert np.isclose(numbers["share"].sum(), 1.0) and np.all(numbers["share"] > 0.0)
    assert np.all(cells > 0.0) and np.all(parts > 0.0)
    contrast = 2.0  # permittivity 3; the triangle inequality, to first order in the contrast
    assert np.all(parts < contrast * np.array([cells[part == index].sum() for index in range(len(parts))]))


def explanations_left(numbers):
    """Weights are shares, an explanation that is counted more widely holds no less, and bounds fall with the SNR."""
    triples = list(zip(numbers["case"], numbers["slot"], numbers["snr_db"]))
    assert len(set(triples)) == len(triples) > 0
    heaviest, number = numbers["heaviest"], numbers["explanations"]
    # of shares p: max(p)^2 <= sum p^2 <= max(p), in 2000 draws that are given away but for one
    assert np.all((heaviest > 0.0) & (heaviest <= 1.0 + 1e-9) & (number >= 1.0 - 1e-9))
    assert np.all((number >= 0.99 / heaviest) & (number <= 1.01 / heaviest**2))
    assert np.all(numbers["heaviest_by_heading"] <= heaviest + 1e-9)
    assert np.all(numbers["heaviest_wide"] >= heaviest - 1e-9)
    assert np.all((numbers["craft_probability"] >= 0.0) & (numbers["craft_probability"] <= 1.0 + 1e-6))
    for case, slot in {(case, slot) for case, slot, _ in triples}:
        mine = (numbers["case"] == case) & (numbers["slot"] == slot)
        order = np.argsort(numbers["snr_db"][mine])
        for name in ("bound_m", "bound_mde"):
            assert np.all(np.diff(numbers[name][mine][order]) < 0.0)
    loudest = numbers["snr_db"] == numbers["snr_db"].max()
    assert np.mean(numbers["expected_error_m"][loudest]) < np.mean(numbers["prediction_error_m"][loudest])


def prediction_errors(numbers):
    """Differences multiply noise by a known gain, more noise never helps; what is learned helps on agile flights."""
    names, styles = list(numbers["predictors"]), list(numbers["styles"])
    mean, median, q95, largest = (numbers[f"{name}_m"] for name in ("mean", "median", "q95", "largest"))
    assert mean.shape == (len(numbers["boxes"]), len(styles), len(numbers["noises_m"]), len(names))
    assert np.all((0.0 < median) & (median < q95) & (mean < q95) & (q95 < largest * 1.2))
    assert np.all(mean[:, :, -1] > mean[:, :, 0])
    # gains (2.5, -2, 0.5) of noise of 0.3 m along each axis, whose length is 1.6 standard deviations of one
    differences = mean[:, styles.index("smooth"), -1, names.index("finite differences")]
    assert np.allclose(differences, np.sqrt(10.5) * 1.596 * numbers["noises_m"][-1], rtol=0.05)
    filtered, corrected, tuned = (
        mean[:, :, :, names.index(name)] for name in ("Kalman", "Kalman + LSTM", "Kalman, tuned")
    )
    agile = styles.index("dynamic")
    # of 1,000 flights 0.53 to 0.80
    assert np.all(corrected[:, agile, 1:] < 0.9 * filtered[:, agile, 1:])
    assert np.all(tuned < 1.1 * filtered)


def beside_planes(numbers):
    """Free space is nobody's environment; planes add to the channel, and a descent ends no higher than it began."""
    level, snr = numbers["level"], numbers["snr_db"]
    keys = list(zip(numbers["case"], level, numbers["slot"], snr))
    assert len(set(keys)) == len(keys) and {0.0} < set(level) and np.all((level >= 0.0) & (level <= 1.0))
    free = level == 0.0
    assert np.all(numbers["added"][free] == 0.0) and np.all(numbers["added"][~free] > 0.0)
    assert np.all(numbers["known_cost"] <= numbers["known_start_cost"] + 1e-6)
    for case in set(numbers["case"]):
        mine = numbers["case"] == case
        added = [np.mean(numbers["added"][mine & (level == each)]) for each in np.unique(level[mine])]
        assert np.all(np.diff(added) > 0.0)
        explained = [np.mean(numbers["explained"][mine & (level == each)]) for each in np.unique(level[mine])]
        assert explained[-1] <= explained[0]
        for slot, each in {(slot, each) for slot, each in zip(numbers["slot"][mine], level[mine])}:
            row = mine & (numbers["slot"] == slot) & (level == each)
            for name in ("bound_m", "bound_mde"):
                assert np.all(np.diff(numbers[name][row][np.argsort(snr[row])]) < 0.0)
    for name in ("craft_probability", "probability", "known_probability"):
        assert np.all((numbers[name] >= 0.0) & (numbers[name] <= 1.0 + 1e-6))
    assert np.mean(numbers["error_m"][free]) < np.mean(numbers["prediction_error_m"][free])
    # planes that are known leave an explanation where the truth is
    assert np.mean(numbers["truth_explained"]) > 0.6
    assert np.mean(numbers["truth_error_m"]) < np.mean(numbers["prediction_error_m"])


def cross_sections(numbers):
    """Metal parts add to plastic, conducting all over most; at these sizes more wavelengths across scatter more."""
    found = numbers["rcs_dbsm"].astype(float)
    crafts, materials, tones = len(numbers["names"]), 3, len(numbers["frequency_hz"])
    assert found.shape == (crafts, materials, tones, len(numbers["directions"]), 3)
    np.testing.assert_allclose(np.linalg.norm(numbers["directions"], axis=1), 1.0, atol=1e-6)
    assert np.linalg.norm(numbers["directions"].mean(axis=0)) < 0.01  # no side is preferred
    mean = 10.0 * np.log10(np.mean(10.0 ** (found[..., :2] / 10.0), axis=(3, 4)))
    assert np.all(np.diff(mean, axis=1) > 2.0)  # dB, from plastic to metal parts to conducting
    assert np.all(np.diff(mean[:, 0], axis=1) > 1.0)
    cross = 10.0 * np.log10(np.mean(10.0 ** (found[..., 2] / 10.0), axis=3))
    assert np.all(cross < mean)
    assert np.all((numbers["metal_cells"] > 0) & (numbers["metal_cells"] < 0.5 * numbers["cells"]))


def turning_rotors(numbers):
    """The hull's line is at 2 v/lambda, rotors add none beyond their tips, and more than is left out."""
    from august_jax.physics import doppler_shift, doppler_spectrum

    interval = float(numbers["approaching_interval_s"])
    shifts, spectrum = doppler_spectrum(numbers["approaching"], interval)
    peaks = shifts[np.argmax(np.abs(spectrum), axis=0)]
    assert np.all(np.abs(peaks - doppler_shift(10.0, 1.0) * numbers["tones_hz"]) < 1.0 / (interval * len(shifts)))
    shifts, spectrum = doppler_spectrum(numbers["hovering"], float(numbers["interval_s"]))
    power = np.abs(spectrum) ** 2
    tip = max(doppler_shift(2.0 * np.pi * numbers["rates_hz"] * numbers["radii_m"], 3e9))
    flash = 2.0 * numbers["rates_hz"].max()  # Bessel's functions fall off over a few lines beyond their argument
    assert np.all(numbers["blades"] == 2)
    outer, beyond = np.abs(shifts) > 0.6 * tip, np.abs(shifts) > tip + 3.0 * flash
    assert power[beyond].sum() < 1e-3 * power[outer].sum()
    turning = np.abs(shifts) > 0.5 * flash
    assert power[outer].sum() > 1e-3 * power[turning].sum() > 0.0
    left, added = (np.sqrt(np.sum(np.abs(numbers[name]) ** 2, axis=(1, 2, 3))) for name in ("left_out", "added"))
    assert np.all((left > 0.0) & (left < 0.8 * added))


def coupling_near(numbers):
    """Both ways come nearer to the finest lattice with the size of cells, and of small ones do not differ much."""
    difference, sizes = numbers["difference"], numbers["sizes_mm"]
    assert difference.shape == (2, len(sizes), len(numbers["permittivities"])) and numbers["finest_mm"] < sizes.min()
    assert np.all(difference > 0.0) and np.all(np.diff(numbers["cells"]) > 0)
    assert np.all(difference[:, -1].mean(axis=-1) < difference[:, 0].mean(axis=-1))
    assert np.all(np.abs(difference[1] - difference[0]) < 0.05)


LAWS = {
    "convergence": cell_size,
    "craft_rcs": cross_sections,
    "design": array_design,
    "environment": beside_planes,
    "limits": what_physics_allows,
    "link_budget": echo_over_the_box,
    "near_coupling": coupling_near,
    "prediction": prediction_errors,
    "refine_pose": pose_by_gradients,
    "rotor_doppler": turning_rotors,
    "sensitivity": parts_of_a_drone,
    "threshold": explanations_left,
    "trust": trust,
}
"""What the numbers of a study must show, whatever the lattice."""


def test_every_study_has_a_law():
    assert sorted(LAWS) == STUDIES, "a study in experiments/ needs a law in LAWS above: what its numbers must show"


@pytest.mark.parametrize("study", STUDIES)
def test_results_that_cannot_be_drawn_are_refused_with_the_way_out(study, tmp_path, monkeypatch, capsys):
    whole = (STORED / f"{study}.npz").read_bytes()
    (tmp_path / "damaged.npz").write_bytes(whole[: len(whole) // 2])
    np.savez(tmp_path / "of_another.npz", some=np.zeros(3))
    for name in ("missing", "damaged", "of_another"):
        path = tmp_path / f"{name}.npz"
        with pytest.raises(SystemExit) as ended:
            scripts.run("experiments", study, "draw", "--results", str(path), monkeypatch=monkeypatch)
        told = capsys.readouterr().err.strip().splitlines()[-1]
        assert ended.value.code == 2 and f"--results: {path}" in told and "compute" in told
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.parametrize("study", STUDIES)
def test_stored_results_obey_the_law_and_are_drawn(study, tmp_path, monkeypatch):
    """What lies in experiments/results is what the scripts read now."""
    results = tmp_path / f"{study}.npz"
    results.write_bytes((STORED / results.name).read_bytes())
    with np.load(results) as numbers:
        LAWS[study](numbers)
    scripts.run("experiments", study, "draw", "--results", str(results), monkeypatch=monkeypatch)
    assert_ink(results.with_suffix(".png"))


@pytest.mark.slow
@pytest.mark.usefixtures("optimized")  # searches among them
@pytest.mark.filterwarnings("ignore:cells.volumes")  # small studies take coarse cells
@pytest.mark.parametrize("study", STUDIES)
def test_a_study_computed_small_obeys_the_law_and_is_drawn(study, tmp_path, monkeypatch):
    module = scripts.imported("experiments", study, monkeypatch)
    numbers = module.compute(True)
    for name, values in numbers.items():
        assert np.all(np.isfinite(values)) if values.dtype.kind in "fc" else values.size, name
    LAWS[study](numbers)
    module.draw(numbers, tmp_path / "drawn.png")
    assert_ink(tmp_path / "drawn.png")


def assert_ink(png):
    """A picture with something on it, and room about that."""
    picture = imread(png)
    inked = np.mean(np.any(picture[..., :3] < 0.9, axis=-1))
    assert min(picture.shape[:2]) > 300 and 0.01 < inked < 0.8
