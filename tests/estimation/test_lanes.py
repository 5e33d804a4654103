"""Segments distributed over devices give the same fit on two devices as on one.

The number of devices is set when JAX starts, so that each fit runs in a process of its own.
"""

import json
import subprocess
import sys

import pytest

SCRIPT = """
import sys, json, jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[2])
import rig
from fitting.estimation.estimate import fit
from fitting.estimation.problem import Segmentation
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import base_paths

experiment = rig.reduced_experiment(2048, noise=1e-5)
model = rig.reduced_model()
start = model.replace({"omega_0": 1.02 * model.drive.omega_0})
# Machine code shares lanes among threads; the devices are XLA's.
found = fit(start, [Stretch(experiment, 0, 2048)], base_paths(model), Segmentation(128), engine="XLA")
devices = len(found.problem.segments.measured.sharding.device_set)
print(json.dumps([devices, found.unknowns.parameters.tolist(), float(found.principal_std)]))
"""


@pytest.fixture(scope="module")
def fits_by_device_count(request):
    folder = str(request.path.parents[1])

    def fitted(devices: int):
        command = [sys.executable, "-c", SCRIPT, str(devices), folder]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
        return json.loads(done.stdout)

    return {n: fitted(n) for n in (1, 2)}


def test_segments_are_distributed_over_all_devices(fits_by_device_count):
    assert (fits_by_device_count[1][0], fits_by_device_count[2][0]) == (1, 2)


def test_fit_does_not_depend_on_the_number_of_devices(fits_by_device_count):
    # Sums in another order; the iteration ends within a small part of a standard error, which is 1e-5 or so.
    assert fits_by_device_count[2][1] == pytest.approx(fits_by_device_count[1][1], rel=1e-8)
    assert fits_by_device_count[2][2] == pytest.approx(fits_by_device_count[1][2], rel=1e-8)
