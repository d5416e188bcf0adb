"""Products of matrices: all digits of single precision where physics is computed, on devices that would round too."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.extend.core import jaxprs_in_params
from jax.lax import Precision
from lattices import cross

from august_jax.config import preset
from august_jax.models import create
from august_jax.physics import PlanarArray, body_channel, factor_body, sensing_channel


@pytest.mark.parametrize("imports", ["import august_jax, jax", "import jax, august_jax"])
@pytest.mark.parametrize("asked, wanted", [(None, "highest"), ("bfloat16", "bfloat16")])
def test_an_import_asks_for_all_digits_unless_the_user_has_asked_for_others(imports, asked, wanted):
    environment = {name: value for name, value in os.environ.items() if name != "JAX_DEFAULT_MATMUL_PRECISION"}
    run = subprocess.run(
        [sys.executable, "-c", f"{imports}; print(jax.config.jax_default_matmul_precision)"],
        env=environment | ({} if asked is None else {"JAX_DEFAULT_MATMUL_PRECISION": asked}),
        text=True,
        capture_output=True,
        check=True,
    )
    assert run.stdout.split() == [wanted]


def test_a_setting_made_in_the_program_before_the_import_stays():
    environment = {name: value for name, value in os.environ.items() if name != "JAX_DEFAULT_MATMUL_PRECISION"}
    code = (
        "import jax; jax.config.update('jax_default_matmul_precision', 'tensorfloat32'); import august_jax; "
        "print(jax.config.jax_default_matmul_precision)"
    )
    run = subprocess.run([sys.executable, "-c", code], env=environment, text=True, capture_output=True, check=True)
    assert run.stdout.split() == ["tensorfloat32"]


def _products(jaxpr) -> list:
    """Precision of every product of matrices in a computation, those inside of others included."""
    found = []
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            found.append(equation.params["precision"])
        for inner in jaxprs_in_params(equation.params):
            found += _products(inner)
    return found


def test_the_simulator_multiplies_in_full_precision():
    cells, array = cross(arm=3), PlanarArray(4, 2, 3e9)
    body = factor_body(cells, 3e9)
    place, chi = jnp.array([1.0, 4.0, 2.0]), jnp.complex64(1.5 + 0.1j)
    traced = [
        jax.make_jaxpr(lambda chi: sensing_channel(array, cells, chi))(chi),
        jax.make_jaxpr(lambda place: body_channel(body, array, np.eye(3), place, chi))(place),
    ]
    for jaxpr in traced:
        products = _products(jaxpr.jaxpr)
        assert products and set(products) == {(Precision.HIGHEST, Precision.HIGHEST)}


def test_the_networks_leave_their_precision_to_the_device():
    denoiser = nnx.merge(*create(preset("smoke"), 0)).denoiser
    context = denoiser.layers[0].gate.kernel.shape[0] - 13
    jaxpr = jax.make_jaxpr(denoiser)(jnp.zeros((2, 4, 5)), jnp.array([1, 2]), jnp.zeros((2, context)))
    products = _products(jaxpr.jaxpr)
    assert products and set(products) <= {None, (Precision.DEFAULT, Precision.DEFAULT)}
