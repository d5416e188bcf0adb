"""The first look of a search on eight devices; run by tests/test_scale.py in a process that sees so many."""

import numpy as np
import pytest
from test_inference_tones import heard, library, slots

from august_jax.inference.screen import screen
from august_jax.mesh import data_mesh

pytestmark = [pytest.mark.usefixtures("optimized"), pytest.mark.filterwarnings("ignore:cells.volumes")]


def test_eight_devices_see_what_one_sees():
    known, statistics, place = library(), heard(0, 30.0), np.asarray(slots().position[0])
    alone, shared = (
        screen(known.survey, known.subspace, statistics, place, known.attitudes, 200, 0.5, mesh=data_mesh(devices))
        for devices in (1, 8)
    )
    np.testing.assert_allclose(shared.residual, alone.residual, rtol=1e-5)
    # candidates as good as each other to the last digit may change places
    same = (shared.craft == alone.craft) & np.all(np.abs(shared.rotation - alone.rotation) < 1e-5, axis=(1, 2))
    assert np.mean(same) > 0.95
    np.testing.assert_allclose(shared.position[same], alone.position[same], atol=1e-5)
    np.testing.assert_allclose(shared.gain[same], alone.gain[same], rtol=1e-4)
