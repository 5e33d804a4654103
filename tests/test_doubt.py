"""When a name stands, and when it falls."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting import doubt
from fitting.attribution.candidate_fit import Setting, Trial
from fitting.close_loop import _base_trial
from fitting.doubt import _explain_all_but_little, _is_little, _names_stand
from fitting.experiment import split
from fitting.learned_look import Candidate
from fitting.measurement_noise import MeasurementNoise
from fitting.unknown import Unknown
from hdjax.effects import Conditions
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.creep import Creep
from hdjax.effects.learned import LearnedMeshTorque
from hdjax.effects.learned_axes import axes_over

NOISE = 1e-3
AXES = axes_over({"v": (-1.0, 1.0)})[0]
LEARNED = LearnedMeshTorque.made_of(AXES, np.eye(AXES[0].count)[:, :1], (1.0,))


@pytest.mark.parametrize(
    ("better_by", "beside", "enough", "come_out", "fewer", "out_of_shape", "stands"),
    [
        (-0.5, True, False, False, 1, True, True),  # what stands in their place is poorer
        (0.0, True, False, False, 0, False, False),  # as good as with what is learned beside them, and something else
        (0.0, True, False, True, 1, False, True),  # as good, and what they name
        (0.0, True, False, True, 0, True, False),  # what they name has another shape
        (0.0, True, False, True, -1, True, True),  # another shape, for more parameters
        (0.9, True, False, True, 0, False, True),
        (0.9, True, False, True, 1, False, False),  # better by far and simpler
        (0.0, False, False, False, 1, False, True),  # as good as they are alone
        (0.9, False, False, False, 0, False, False),
        (0.9, False, False, True, 1, False, False),
        (0.0, False, True, False, 1, False, False),  # they leave but noise, and one function with fewer parameters does
        (0.0, False, True, False, 0, False, True),
        (0.0, False, True, True, 1, False, True),  # it has come out as what they name
        (-0.5, False, True, False, 3, False, True),
    ],
)
def test_when_names_stand(
    better_by: float, beside: bool, enough: bool, come_out: bool, fewer: int, out_of_shape: bool, stands: bool
):
    found = _names_stand(
        better_by=better_by,
        gain=10.0,
        beside=beside,
        enough=enough,
        come_out=come_out,
        fewer=fewer,
        out_of_shape=out_of_shape,
    )
    assert found == stands


@pytest.mark.parametrize(
    ("names", "white", "times_noise", "imperfect", "asks_for"),
    [
        (2, True, 1.0, False, []),
        (2, True, 100.0, False, ["instead", "beside"]),  # white, but no noise: of the motor's angle, say
        (2, False, 100.0, True, []),
        (2, False, 100.0, False, ["instead", "beside"]),
        (3, True, 1.0, False, ["instead"]),  # many names that leave but noise
        (3, False, 100.0, True, ["instead"]),
        (3, False, 100.0, False, ["instead", "beside"]),
    ],
)
def test_what_is_learned_to_doubt_names(
    base: Trial,
    names: int,
    white: bool,
    times_noise: float,
    imperfect: bool,
    asks_for: list[str],
    monkeypatch: pytest.MonkeyPatch,
):
    effects = (Creep(k=1.0, tau=1.0, span=1.0), TorqueBias(), Creep(k=2.0, tau=3.0, span=1.0))[:names]
    named = eqx.tree_at(lambda t: t.model.effects, base, effects)
    asked = []

    def learn(before, *args, **options):
        asked.append("instead" if before is base else "beside")

    monkeypatch.setattr(doubt, "leaves_white_noise", lambda fit: white)
    monkeypatch.setattr(doubt, "leaves_imperfection", lambda before, base, noise: (imperfect, noise))
    monkeypatch.setattr(doubt, "learn_supported", learn)
    setting = Setting(32, 4, 1, 8)
    # Both leave so much.
    noise = MeasurementNoise((NOISE / times_noise) ** 2 * jnp.eye(1), (base.training, named.training))
    options = {"noise": noise, "seed": 0, "progress": lambda message: None}
    assert doubt.what_is_unknown(base, named, {}, setting, **options) == (named, None)
    assert asked == asks_for


@pytest.mark.parametrize(("alike", "asks_for"), [(0.5, ["instead"]), (0.9, ["instead", "beside"])])
def test_where_what_stands_in_their_place_leaves_noise_nothing_is_learned_beside_names(
    base: Trial, alike: float, asks_for: list[str], monkeypatch: pytest.MonkeyPatch
):
    """Unless it has come out as what they name."""
    named = eqx.tree_at(lambda t: t.model.effects, base, (TorqueBias(),))
    asked = []

    def learn(before, *args, **options):
        asked.append("instead" if before is base else "beside")
        chosen = Candidate(LearnedMeshTorque, ("v",), 1.0, LEARNED, np.zeros((2, 1)))
        found = Unknown(
            base, base, (), chosen, np.arange(2), np.zeros((2, 2)), Conditions(), np.ones((2, 2)), 2.0, 0.005
        )
        return found if before is base else None

    monkeypatch.setattr(doubt, "_leaves_noise", lambda trial, noise: trial is base)
    monkeypatch.setattr(doubt, "leaves_imperfection", lambda before, base, noise: (False, noise))
    monkeypatch.setattr(doubt, "share_of", lambda model, found, fit: alike)
    monkeypatch.setattr(doubt, "learn_supported", learn)
    noise = MeasurementNoise((NOISE / 100.0) ** 2 * jnp.eye(1), ())
    options = {"noise": noise, "seed": 0, "progress": lambda message: None}
    trusted, unknown = doubt.what_is_unknown(base, named, {}, Setting(32, 4, 1, 8), **options)
    assert asked == asks_for
    assert (trusted is base) == (unknown is not None) == (alike < 0.75)


@pytest.mark.parametrize(
    ("left", "all_but_little"),
    [
        (1.02, True),
        (1.15, True),  # of a hundredfold error: a twentieth of its logarithm
        (1.3, False),
    ],
)
def test_names_that_noise_itself_would_hardly_better_are_in_no_doubt(base: Trial, left: float, all_but_little: bool):
    def with_error(ratio: float) -> Trial:
        return replace(base, held_out=replace(base.held_out, objective=float(np.log(ratio * NOISE))))

    noise = MeasurementNoise(NOISE**2 * jnp.eye(1), ())
    assert _explain_all_but_little(with_error(100.0), with_error(left), noise) == all_but_little


@pytest.mark.parametrize(
    ("training", "held_out", "little"),
    [
        (0.01, 0.01, True),
        (0.3, 0.01, False),  # the held-out stretches don't show the motion where the names fail
        (0.01, 0.3, False),
    ],
)
def test_what_little_a_learned_torque_adds(training: float, held_out: float, little: bool):
    assert _is_little(added=(training, held_out), explained=(2.0, 1.0)) == little


@pytest.fixture(scope="module")
def base() -> Trial:
    data = {"zero-order": split((rig.reduced_experiment(1200, noise=NOISE),))}
    return _base_trial(rig.reduced_model(), data, "zero-order")[0]


@pytest.mark.parametrize(
    ("told", "missed_by", "left"),
    [
        (set(), 0.0, set()),
        (set(), 0.09, set()),  # hardly missed, of a gain of two
        (set(), 0.2, {"creep", "torque_bias"}),
        ({"torque_bias"}, 0.0, {"torque_bias"}),
        ({"creep"}, 0.0, {"creep"}),
        ({"creep", "torque_bias"}, 0.0, {"creep", "torque_bias"}),
    ],
)
def test_names_that_what_is_learned_leaves_nothing_fall(
    base: Trial, told: set[str], missed_by: float, left: set[str], monkeypatch: pytest.MonkeyPatch
):
    def with_effects(*effects, objective: float) -> Trial:
        model = base.model.with_effects(*effects)
        return replace(base, model=model, held_out=replace(base.held_out, objective=objective))

    def refitted_without(fallen, trial, data, setting):
        kept = [e for e in trial.model.effects if e.name not in fallen]
        learned = any(isinstance(e, LearnedMeshTorque) for e in kept)
        return with_effects(*kept, objective=-7.0 + missed_by if learned else -5.0)

    monkeypatch.setattr(doubt, "told_from_zero", lambda fit, names: told)
    monkeypatch.setattr(doubt, "_refitted_without", refitted_without)
    names = (Creep(k=1.0, tau=1.0, span=1.0), TorqueBias())
    chosen = Candidate(LearnedMeshTorque, ("v",), 1.0, LEARNED, np.zeros((2, 1)))
    named, trial = with_effects(*names, objective=-5.0), with_effects(*names, LEARNED, objective=-7.0)
    motion, push = np.asarray([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), np.ones((2, 3))
    instants = np.arange(2)
    beside = Unknown(named, trial, (), chosen, instants, motion, Conditions(time=jnp.zeros(2)), push, 2.0, 0.005)
    bare, beside = doubt._without_superfluous(base, named, beside, {}, Setting(32, 4, 1, 8))
    assert {e.name for e in bare.model.effects} == left
    assert (bare is base) == (left == set()) and beside.before is bare
    assert {e.name for e in beside.trial.model.effects} == left | {LEARNED.name}
    # The states of what fell are gone with it; creep has one.
    assert beside.states.shape == beside.push.shape == (2, 3 if "creep" in left else 2)
    assert beside.gain == pytest.approx(bare.held_out.objective - beside.trial.held_out.objective)
