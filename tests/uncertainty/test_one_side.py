"""What one side's equation says as priors of the drive's parameters."""

import numpy as np
import pytest

from fitting.estimation.free_parameters import base_paths, free_parameters
from fitting.uncertainty.one_side import without_mesh_priors
from hdjax import Drive, TwoInertiaModel
from hdjax.drive import Prior

INERTIA = Prior("J_l", 0.2, 0.05)
KNOWN = (Prior("K", 300.0, 0.01), Prior("alpha", 20.0, 5.0), Prior("B_sp", 0.4, 0.1))
DRIVE = Drive(N=50.0, J_m=4e-5, J_l=0.2, K=310.0, alpha=30.0, B_sp=0.5, priors=(INERTIA, *KNOWN))


def test_priors_of_the_mesh_are_in_units_of_the_free_vector():
    model = TwoInertiaModel(DRIVE)
    paths = base_paths(model)
    assert paths == ("K", "alpha", "B_sp", "J_l")
    free = free_parameters(model, paths, {"alpha": 100.0})
    off = np.asarray(free.off_prior(free.pack(model)))
    expected = [np.log(310.0 / 300.0) / 0.01, (30.0 - 20.0) / 5.0, np.log(0.5 / 0.4) / 0.1, 0.0]
    np.testing.assert_allclose(off, expected, rtol=1e-12, atol=1e-12)


def test_priors_of_the_drive_file_remain():
    bare = without_mesh_priors(TwoInertiaModel(DRIVE))
    assert bare.drive.priors == (INERTIA,)
    assert float(bare.get("K")) == 310.0


@pytest.mark.parametrize("path", ["K", "B_sp"])
def test_prior_of_a_positive_parameter_is_of_its_logarithm(path: str):
    free = free_parameters(TwoInertiaModel(DRIVE), (path,), {})
    prior = next(p for p in KNOWN if p.path == path)
    assert float(free.centre[0]) == pytest.approx(np.log(prior.value))
    assert float(free.precision[0]) == pytest.approx(1.0 / prior.tolerance)
