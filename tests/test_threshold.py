"""Rules by which studies and evaluation count: one explanation or several, and from which SNR on the bound is met."""

import math

import numpy as np
import pytest
from made_up_posterior import made_up_posterior

from august_jax.app.cli.messages import expected_table
from august_jax.evaluation.explanations import arms, effective_number, explanations, turned_deg
from august_jax.evaluation.threshold import said, threshold_db, thresholds
from august_jax.physics.parameters import rotation_from_vector
from august_jax.scene import procedural_airframe, rotation_from_euler
from august_jax.schemes.matched_field import expected_errors


def of_samples(craft, rotation, log_weight=None, position=None):
    count = len(craft)
    return made_up_posterior(
        np.zeros(3),
        crafts=2,
        craft=np.asarray(craft),
        rotation=np.asarray(rotation, np.float64),
        permittivity=np.full(count, 3.0),
        conductivity=np.full(count, 5e-3),
        position=np.zeros((count, 3)) if position is None else np.asarray(position),
        log_weight=np.full(count, -np.log(count)) if log_weight is None else np.asarray(log_weight),
    )


def about_z(degrees):
    return np.asarray(rotation_from_euler(0.0, 0.0, math.radians(degrees)), np.float64)


def shaken(rotation, count, spread_deg, seed=0):
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=(count, 3))
    turn *= np.radians(spread_deg) * rng.uniform(size=(count, 1)) / np.linalg.norm(turn, axis=1, keepdims=True)
    return np.stack([np.asarray(rotation_from_vector(each.astype(np.float32))) @ rotation for each in turn])


def test_explanations_are_weighed_by_what_lies_about_them():
    """Three clouds of attitudes, 40 degrees apart and 4 wide, of weights 0.6, 0.3 and 0.1."""
    clouds = [shaken(about_z(40.0 * row), 200, 4.0, row) for row in range(3)]
    shares = np.repeat([0.6, 0.3, 0.1], 200) / 200
    posterior = of_samples(np.zeros(600, int), np.concatenate(clouds), np.log(shares))
    weights, about = explanations(posterior, [1, 1])
    np.testing.assert_allclose(weights, [0.6, 0.3, 0.1], atol=2e-3)  # 2000 draws, systematic
    assert [row // 200 for row in about] == [0, 1, 2]
    assert effective_number(weights) == pytest.approx(1.0 / (0.36 + 0.09 + 0.01), rel=0.01)


def test_turns_from_arm_to_arm_are_one_explanation_and_other_craft_are_not():
    turned = [about_z(angle) for angle in (5.0, 95.0, 185.0, 275.0)]
    four = of_samples([0, 0, 0, 0], turned)
    assert explanations(four, [4, 1])[0] == pytest.approx([1.0])
    assert explanations(four, [1, 1])[0] == pytest.approx([0.25] * 4)
    assert explanations(four, [3, 1])[0] == pytest.approx([0.25] * 4)  # 30 degrees apart at best
    assert explanations(of_samples([0, 1, 0, 1], turned), [4, 4])[0] == pytest.approx([0.5, 0.5])
    with pytest.raises(ValueError, match="folds: got 1 for a library of 2 craft"):
        explanations(four, [4])


def test_where_a_craft_stands_makes_no_second_explanation():
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (100, 3))
    near = of_samples(np.zeros(100, int), np.tile(np.eye(3), (100, 1, 1)), position=places)
    assert explanations(near, [1, 1])[0] == pytest.approx([1.0])


def test_an_explanation_ends_at_its_radius():
    pair = of_samples([0, 0], [np.eye(3), about_z(12.0)])
    assert len(explanations(pair, [1, 1])[0]) == 2
    assert len(explanations(pair, [1, 1], radius_deg=15.0)[0]) == 1
    tilted = np.asarray(rotation_from_euler(math.radians(7.0), 0.0, 0.0), np.float64)
    assert turned_deg(np.eye(3), tilted @ about_z(90.0), 4) == pytest.approx(7.0, abs=1e-3)
    assert turned_deg(np.eye(3), tilted @ about_z(90.0), 1) > 89.0


def test_arms_are_counted_by_where_rotors_lie():
    names = ("quad_x", "quad_plus", "hexa", "octo", "coaxial_y6")
    assert [arms(procedural_airframe(name)) for name in names] == [4, 4, 6, 8, 3]


@pytest.mark.parametrize(
    "ratios, wanted, words",
    [
        ((5.0, 2.0, 1.2, 1.0), 20.0, "20 dB"),
        ((1.4, 1.0, 1.2, 1.1), -math.inf, "below 0 dB"),
        ((9.0, 5.0, 3.0, 1.6), None, "not reached by 30 dB"),
        ((1.0, 2.0, 1.0, 1.0), 20.0, "20 dB"),  # near the prior, errors may come near the bound and part again
        ((1.0, 1.0, 1.0, 2.0), None, "not reached by 30 dB"),
        ((2.0, 2.0, 2.0, 1.5), 30.0, "30 dB"),
    ],
)
def test_the_threshold_is_where_the_bound_is_met_for_good(ratios, wanted, words):
    snrs, bound = np.array([0.0, 10.0, 20.0, 30.0]), np.array([0.2, 0.1, 0.05, 0.02])
    for order in (slice(None), slice(None, None, -1), [2, 0, 3, 1]):
        found = threshold_db(snrs[order], (np.array(ratios) * bound)[order], bound[order])
        assert found == wanted and said(found, snrs) == words


def test_thresholds_are_told_of_schemes_that_expect_errors():
    none = {"expected_mpe_m": None, "expected_mde": None, "own_bound_m": 0.02, "own_bound_mde": 1e-3}
    rows = [
        {"scheme": scheme, "snr_db": snr, **none, **values}
        for snr, error, normal in ((0.0, 0.3, 0.1), (20.0, 0.025, 0.05), (30.0, 0.02, 2e-3))
        for scheme, values in {"august": {}, "matched_field": {"expected_mpe_m": error, "expected_mde": normal}}.items()
    ]
    position, normal = thresholds(rows)
    assert position == {
        "scheme": "matched_field", "of": "position", "within": 1.5, "threshold_db": 20.0, "said": "20 dB",
    }  # fmt: skip
    assert (normal["of"], normal["within"], normal["threshold_db"]) == ("normal", 2.25, 30.0)
    assert thresholds([row | {"own_bound_m": None, "own_bound_mde": None} for row in rows]) == []
    with pytest.raises(ValueError, match="snr_db, expected, bound: give finite numbers"):
        threshold_db(np.array([0.0]), np.array([np.nan]), np.array([1.0]))


def test_a_posterior_expects_what_its_samples_err():
    """E(1 - n.n_mean) is 1 - |E n|: two normals at right angles leave 1 - 1/sqrt(2)."""
    tilted = np.asarray(rotation_from_euler(math.radians(90.0), 0.0, 0.0), np.float64)
    found = of_samples([0, 0], [np.eye(3), tilted], position=[[0.0, 0.0, 0.3], [0.0, 0.4, 0.0]])
    error_m, normal = expected_errors(found)
    assert error_m == pytest.approx(0.25) and normal == pytest.approx(1.0 - math.sqrt(0.5))
    rng = np.random.default_rng(0)
    spread = of_samples(
        np.zeros(5000, int), np.tile(np.eye(3), (5000, 1, 1)), position=0.1 * rng.normal(size=(5000, 3))
    )
    assert expected_errors(spread)[0] == pytest.approx(0.1 * math.sqrt(8.0 / math.pi), rel=0.03)  # of a Gaussian
    assert expected_errors(spread)[1] == pytest.approx(0.0, abs=1e-9)


def test_the_table_tells_errors_expected_ones_and_bound_side_by_side():
    none = dict.fromkeys(("mpe_m", "expected_mpe_m", "mpe_over_expected", "mde", "expected_mde", "mde_over_expected"))
    rows = [
        {"scheme": scheme, "snr_db": 20.0, "own_bound_m": 0.05, "own_bound_mde": 1e-3, **none, **values}
        for scheme, values in {
            "august": {"mpe_m": 0.127, "mde": 0.031},
            "matched_field": {
                "mpe_m": 0.051, "expected_mpe_m": 0.048, "mpe_over_expected": 1.0625,
                "mde": 0.023, "expected_mde": 0.012, "mde_over_expected": 1.9,
            },
        }.items()
    ]  # fmt: skip
    told = expected_table(rows, thresholds(rows)).splitlines()
    assert told[1].split() == "matched_field 20 0.051 0.048 1.06 0.050 0.0230 0.0120 1.90 0.0010".split()
    assert told[2:] == [
        "matched_field: the expected error of its position is within 1.5 times the bound from: below 20 dB",
        "matched_field: the expected error of its normal is within 2.25 times the bound from: not reached by 20 dB",
    ]
    assert expected_table(rows[:1], []) == ""
