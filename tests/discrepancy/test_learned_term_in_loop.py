"""The loop with a learned term: its decision, its report, and a named effect beside the term."""

import dataclasses
import json
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

import rig
from fitting.attribution.selection_round import Verdict
from fitting.estimation.free_run import free_run
from fitting.loop import close_loop
from fitting.outcome import Loop
from fitting.report import Report, report_dict
from fitting.report.alternatives import alternatives
from fitting.search_options import SearchOptions
from fitting.stored_model import read_model
from hdjax import Model
from hdjax.effects.damping import QuadraticDamping
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.stiffness import QuadraticStiffness

COUNT = 1600
NOISE = 1e-3
FRICTION = (10.0, 0.3)


@pytest.fixture(scope="module")
def loop() -> Loop:
    """A loop whose catalogue lacks the family of the missing effect."""
    experiment = rig.reduced_experiment(COUNT, noise=NOISE, friction=FRICTION)
    catalogue = (QuadraticStiffness, QuadraticDamping)
    placeholder: Model = rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0)
    options = {"catalogue": catalogue, "search": SearchOptions(1)}
    return close_loop(placeholder, {"zero-order": (experiment,)}, hold="zero-order", **options)


def test_effect_missing_from_the_catalogue_is_unexplained(loop: Loop):
    assert loop.decision == "unexplained"
    assert [f.family for f in loop.findings] == ["unknown"]
    assert loop.unknown is not None and "v" in loop.unknown.chosen.variables
    assert loop.after.rmse["selection"] < 2 * NOISE < loop.before.rmse["selection"]
    assert loop.findings[0].p_value <= 0.01
    assert float(loop.after.model.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=1e-3)


def test_report_states_the_learned_term(loop: Loop, tmp_path: Path):
    units = {"dynamic_error": "V", "forcing": "<b>V</b>"}
    paths = Report.of(loop, units=units).write(tmp_path)
    report = json.loads(paths["report.json"].read_text())
    told = report["unknown"]
    assert told["family"] == "unknown" and told["place"] == "mesh" and "v" in told["variables"]
    assert told["rmse"]["before"] > 2 * told["rmse"]["after"]
    assert told["shapes"][0]["r_squared"] <= 1.0
    assert [e["family"] for e in report["after"]["effects"]] == ["unknown"]
    assert "does not explain" in report["summary"] and "twist rate" in report["summary"]
    page = paths["report.html"].read_text()
    assert "What the learned torque looks like" in page and 'id="learned-torque"' in page
    assert "<b>V</b>" not in page
    # The stored model predicts the same as the loop.
    read = read_model(paths["model.json"])
    options = {"covariance": loop.noise, "halo": loop.setting.halo, "substeps": loop.after_substeps}
    (run,) = free_run(read.model, loop.stretches[1], **options)
    assert run.rmse == pytest.approx(loop.after.rmse["selection"], rel=0.05)


@pytest.mark.slow
def test_true_named_effect_stands_beside_a_learned_term(tmp_path: Path):
    """The log has friction and a quadratic spring; the catalogue has friction alone.

    A free function of the rate in its place explains no more than friction. A function of the twist beside it explains
    all of the rest.
    """
    experiment = rig.reduced_experiment(COUNT, noise=NOISE, friction=(25.0, 0.3), quadratic=0.15)
    placeholder: Model = rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0)
    options = {"catalogue": (CoulombFriction,), "search": SearchOptions(1)}
    loop = close_loop(placeholder, {"zero-order": (experiment,)}, hold="zero-order", **options)
    assert loop.decision == "effect_found" and not loop.doubted
    assert [f.name for f in loop.findings] == ["coulomb_friction", "learned_mesh_torque"]
    assert loop.unknown is not None and loop.unknown.chosen.variables == ("x",)
    assert float(loop.after.model.get("coulomb_friction.T_c")) == pytest.approx(25.0, rel=0.05)
    assert loop.after.rmse["selection"] < 1.2 * NOISE
    # The second gain is relative to the error after the first.
    left = loop.before.rmse["selection"] * np.prod([1.0 - f.gain for f in loop.findings])
    assert left == pytest.approx(loop.after.rmse["selection"], rel=1e-6)
    units = {"dynamic_error": "V", "forcing": "V"}
    paths = Report.of(loop, units=units).write(tmp_path)
    report = json.loads(paths["report.json"].read_text())
    assert "friction" in report["summary"] and "Something unknown is also missing" in report["summary"]
    assert report["unexplained"] is None and report["unknown"]["variables"] == ["x"]
    assert "What the learned torque looks like" in paths["report.html"].read_text()
    assert eqx.tree_equal(read_model(paths["model.json"]).model, loop.after.model, rtol=1e-12)


def test_tied_learned_term_is_told_in_words(loop: Loop):
    """A name that was found, and the learned term as its tie."""
    assert loop.unknown is not None
    friction = Verdict("coulomb_friction", "coulomb_friction", loop.unknown.trial, 1.0, 0.001, separable=True)
    first = dataclasses.replace(loop.rounds[0], verdicts=(friction,), accepted=True)
    finding = dataclasses.replace(loop.findings[0], name=friction.name, family=friction.family)
    changed = {"tied": loop.unknown, "unknown": None, "compared": (first,), "findings": (finding,)}
    (tie,) = alternatives(Loop(**(vars(loop) | changed)))
    assert (tie["family"], tie["instead_of"], tie["separable"]) == ("unknown", "coulomb_friction", False)
    assert tie["name"].startswith("learned torque in the mesh, a function of the") and "twist rate" in tie["name"]
    assert tie["selection_rmse"] == tie["selection_rmse_of_found"]
    assert "ring down" in tie["separating_experiment"]


def test_report_without_a_learned_term_has_none(loop: Loop):
    assert report_dict(Loop(**(vars(loop) | {"unknown": None, "findings": ()})))["unknown"] is None
