"""What one side's equation says as priors of the drive's parameters, and which effects contradict it."""

import dataclasses

import numpy as np

import joints
from fitting.attribution.screening import screen
from fitting.estimation.estimate import Start, Strategy, fit
from fitting.estimation.experiment import experiment_from_log, split, whole
from fitting.estimation.free_parameters import base_paths, free_parameters
from fitting.estimation.one_side import fit_of_side
from fitting.estimation.problem import Segmentation
from fitting.uncertainty.one_side import contradicts, with_mesh_priors, without_mesh_priors
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Drive, MotorDrivenModel, TwoInertiaModel
from hdjax.drive import Prior
from hdjax.effects import (
    LoadEncoderDelay,
    LoadInertiaError,
    MotorInertiaError,
    TorqueGain,
    ViscousLoadFriction,
    ViscousMotorFriction,
)

JOINT = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, alpha=300.0, rms=0.05)
INERTIA = Prior("J_l", 0.2, 0.05)
KNOWN = (Prior("K", 300.0, 0.01), Prior("alpha", 20.0, 5.0), Prior("B_sp", 0.4, 0.1))
DRIVE = Drive(N=50.0, J_m=4e-5, J_l=0.2, K=310.0, alpha=30.0, B_sp=0.5, priors=(INERTIA, *KNOWN))


def test_priors_of_the_mesh_are_in_units_of_the_free_vector():
    model = TwoInertiaModel(DRIVE)
    paths = base_paths(model)
    assert paths == ("K", "alpha", "B_sp", "J_l")
    free = free_parameters(model, paths, {"alpha": 100.0})
    off = np.asarray(free.off_prior(free.pack(model)))
    expected = [np.log(310.0 / 300.0) / 0.01, (30.0 - 20.0) / 5.0, (0.5 - 0.4) / 0.1, 0.0]
    np.testing.assert_allclose(off, expected, rtol=1e-12, atol=1e-12)


def test_priors_of_the_drive_file_remain():
    bare = without_mesh_priors(TwoInertiaModel(DRIVE))
    assert bare.drive.priors == (INERTIA,)
    assert float(bare.get("K")) == 310.0


def test_priors_of_the_mesh_are_the_estimates_of_one_side():
    """In the free vector a parameter one standard error off its estimate is one unit off its prior."""
    stretches = whole([experiment_from_log(joints.log_of(JOINT), hold="zero-order", N=JOINT.N)])
    bare = TwoInertiaModel(Drive(N=JOINT.N, J_m=JOINT.J_m, J_l=JOINT.J_l, K=JOINT.K))
    side = fit_of_side(MotorDrivenModel, bare, stretches)
    assert side is not None
    known = uncertainty(side).estimates
    model = with_mesh_priors(bare, side)
    off = model.replace({path: e.value + 0.01 * e.std for path, e in known.items()})
    free = free_parameters(off, base_paths(off), {})
    np.testing.assert_allclose(np.asarray(free.off_prior(free.pack(off))), 0.01, rtol=1e-3)


def test_equation_of_the_load_says_nothing_about_effects_on_its_inertia_or_on_the_readings():
    stated = dataclasses.replace(JOINT, J_l=1.1 * JOINT.J_l)
    training, held_out = split([experiment_from_log(joints.log_of(JOINT), hold="zero-order", N=JOINT.N)])
    bare = TwoInertiaModel(Drive(**{p: getattr(stated, p) for p in ("N", "J_m", "J_l", "K", "alpha", "B_sp")}))
    side = fit_of_side(MotorDrivenModel, bare, training)
    assert side is not None
    for effect in (LoadInertiaError(), LoadEncoderDelay()):
        assert contradicts(effect, side) and not contradicts(effect, None)
    for effect in (MotorInertiaError(), TorqueGain(), ViscousMotorFriction()):
        assert not contradicts(effect, side)

    # The prior holds K in proportion to the stated inertia, except beside an effect that corrects this.
    model = with_mesh_priors(bare.replace({p: side.model.get(p) for p in ("K", "alpha", "B_sp")}), side)
    found = fit(model, training, base_paths(model), Segmentation(128))
    start, held = Start(found.covariance), Strategy(hold_parameters=True)
    unseen = fit(found.model, held_out, found.free.paths, found.segmentation, start=start, strategy=held)
    leads = screen(found, unseen, catalogue=(LoadInertiaError, ViscousLoadFriction), side=side).leads
    moved = {lead.effect.name: lead.drive_changes["K"] / JOINT.K for lead in leads}
    assert abs(moved["viscous_load_friction"]) < 1e-3
    assert -0.2 < moved["load_inertia_error"] < -0.02
