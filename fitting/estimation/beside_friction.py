"""Base fit where the dynamic error was not measured, with and without friction of the motor.

The base model can take energy from the motor only through the mesh, so that friction of the motor leads its fit to any
K. Where both angles were measured, the load's equation of motion determines K (see
[`fitting.estimation.one_side`][]). Here friction is fitted together with the drive. Where it explains most of the
residual, the drive's parameters are fixed at that fit's values.
"""

from collections.abc import Sequence

from fitting.estimation.driven_load import friction_from_motor
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import fitted_paths
from fitting.estimation.problem import Segmentation, short_horizon, suggested_substeps
from fitting.estimation.scales import largest_torque, scales
from hdjax import Model, TwoInertiaModel
from hdjax.effects import MotorFriction

# Least starting value of Coulomb friction over the largest torque; it is fitted by its logarithm.
_LEAST = 1e-3
# Iterations of a trial fit, enough to rank the starts.
_TRIAL_STEPS = 10
# Share of the rms speed over which the sign of friction turns.
_TURN = 0.01


def fits_of_starts(starts: Sequence[Model], training: Sequence[Stretch], halo: int) -> tuple[Fit, Fit, Model]:
    """The fit of the drive alone, that of the drive with motor friction, and their starting model.

    Args:
        starts: models with starting values, the most likely one first.
        training: the data.
        halo: intervals of torque before a segment.
    """
    # Equally short segments make the starts' objectives comparable.
    horizon = short_horizon(starts[0], training)

    def fitted(model: Model, like: Sequence[Model], strategy: Strategy = Strategy()) -> Fit:
        substeps = max(suggested_substeps(m, training) for m in like)
        segmentation = Segmentation(horizon, None, halo, substeps)
        return _fitted(model, strategy, training=training, segmentation=segmentation)

    rubbing = [(fitted(beside_friction(s, training), starts, Strategy(_TRIAL_STEPS)), s) for s in starts]
    best, start = min(rubbing, key=lambda pair: pair[0].objective)
    beside, alone = fitted(best.model, [best.model]), fitted(start, [best.model])
    if beside.objective < alone.objective:
        # Where friction is small, both fits have similar parameters.
        other = fitted(beside.model.without_effect(MotorFriction.name), [best.model])
        alone = min(alone, other, key=lambda f: f.objective)
    return alone, beside, start


def beside_friction(model: Model, training: Sequence[Stretch]) -> Model:
    """The model with motor friction at its starting values, from the balance of the motor's momentum."""
    assert isinstance(model, TwoInertiaModel)
    T_c, b = friction_from_motor(model, training)
    T_c = max(T_c, _LEAST * largest_torque(training))
    speed = scales(training, model).omega_m
    return model.with_effects(MotorFriction(T_c=T_c, b=max(b, 0.0), transition=_TURN * speed))


def refitted_beside(held: Fit) -> Fit:
    """The fit with friction that supplied a base fit's fixed values."""
    return _fitted(beside_friction(held.model, held.stretches), training=held.stretches, segmentation=held.segmentation)


def _fitted(
    model: Model, strategy: Strategy = Strategy(), *, training: Sequence[Stretch], segmentation: Segmentation
) -> Fit:
    paths = [p for p in fitted_paths(model) if not p.endswith(".transition")]
    return fit(model, training, paths, segmentation, strategy=strategy)
