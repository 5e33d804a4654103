"""Evidence for a refitted effect: significance of its strength, removed error, plausibility of its values."""

from collections.abc import Collection, Iterable, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.case_evidence import NoiseEvidence
from fitting.attribution.decisions import only_noise
from fitting.attribution.rules import RULES
from fitting.estimation.base_fit import leaves_white_noise
from fitting.estimation.estimate import Fit, lost
from fitting.estimation.free_parameters import effect_paths, strength_paths
from fitting.uncertainty.measurement_noise import MeasurementNoise
from fitting.uncertainty.noise_model import NoiseModel, noise_model
from fitting.uncertainty.normal_law import NORMAL_95
from fitting.uncertainty.standard_errors import Estimate, Uncertainty, uncertainty
from hdjax import ReducedModel
from hdjax.effects import Effect
from hdjax.parameters import own_parameters


def strength_errors(fit: Fit, names: Collection[str]) -> dict[str, float]:
    """Largest distance from zero, in standard errors, of each effect's strengths that its name refers to.

    The shape is fixed as fitted: at zero strength it is undefined, and strength may be confounded with shape (a creep's
    stiffness with its time).

    Args:
        fit: of the model.
        names: of the effects.
    """
    if not names:
        return {}
    found = uncertainty(fit, torque_noise=False)
    return {name: _strength_errors(found, fit.model.effect(name)) for name in names}


def nonzero_effects(fit: Fit, names: Collection[str]) -> set[str]:
    """Effects with at least one significantly nonzero strength; arguments as in [`strength_errors`][]."""
    return {name for name, errors in strength_errors(fit, names).items() if errors > RULES.strength_errors}


def _strength_errors(found: Uncertainty, effect: Effect) -> float:
    paths, strengths = list(found.estimates), strength_paths(effect)
    shape = [paths.index(p) for p in effect_paths(effect) if p not in strengths]
    across = found.covariance[:, shape]
    explained = np.einsum("pi,ij,pj->p", across, np.linalg.pinv(across[shape], hermitian=True), across)
    total = np.diag(found.covariance)
    part = np.sqrt(np.clip(1.0 - explained / np.maximum(total, 1e-300), 0.0, 1.0))
    told = [f"{effect.name}.{n}" for n in effect.named_for] or strengths
    return max(_errors_of(found.estimates[p], float(part[paths.index(p)]), effect) for p in told)


def _errors_of(estimate: Estimate, part: float, effect: Effect) -> float:
    """Distance of one strength from zero in standard errors, without the error due to its shape; for a positive one by
    its logarithm."""
    upper = estimate.ci95[1]
    if dict(own_parameters(effect))[estimate.path.split(".")[1]].positive:
        size, error = 1.0, part * float(np.log(max(upper / estimate.value, 1.0)))
    else:
        size, error = abs(estimate.value), part * (upper - estimate.value)
    return NORMAL_95 * size / max(error, 1e-300)


def imperfection(effects: Iterable[Effect]) -> float:
    """Possible rms error of the effects' laws, as a share of what they have removed."""
    return max((effect.imperfection for effect in effects), default=0.0)


def leaves_imperfection(before: Trial, base: Trial, noise: MeasurementNoise) -> tuple[bool, MeasurementNoise]:
    """Whether measurement noise and inexact laws of a model's effects may explain its residual, so that no further
    effect could remove more.

    Args:
        before: the model.
        base: the model without effects.
        noise: of the measured outputs, where it was estimated.

    Returns:
        Whether it is so, and the noise, which is estimated with this model as well where needed: it may be smaller than
        with the base model.
    """
    small = imperfection(before.model.effects)
    if _share(before, base, np.diag(np.asarray(noise.covariance))) > small:
        return False, noise
    noise = noise.and_beside(before.training)
    return _share(before, base, np.diag(np.asarray(noise.covariance))) <= small, noise


def noise_evidence(left: NoiseModel) -> NoiseEvidence:
    """Noise evidence for the decisions."""
    return NoiseEvidence(left.share, left.predictable, left.size)


def is_noise(left: NoiseModel | None) -> bool:
    """Whether noise may explain a model's whole residual."""
    return left is not None and all(check.holds for check in only_noise(noise_evidence(left)))


def shows_noise(left: NoiseModel, found: Fit) -> bool:
    """Whether a residual over short segments shows the sensor noise that explains it. Initial states absorb slow noise
    of an angle, but not of the twist.

    Where the linearised motion explodes, as in chaos, the noise model takes what it leaves for very slow noise.

    Args:
        left: the noise model.
        found: the fit over short segments.
    """
    said = float(np.sqrt(left.sensors.covariance[-1, -1]))
    return found.model.measured[-1] != "dynamic_error" or said < RULES.excess * found.principal_std


def noise_of_torque(left: NoiseModel | None) -> float | None:
    """Standard deviation of the torque noise [N m]; None where sensor noise alone explains as much."""
    return left.std if left is not None and left.likelihood - left.without > RULES.noise_gain else None


class Standing:
    """The current model, which a further effect must improve.

    Attributes:
        before: the current model.
        base: the model without any effect.
        noise: of the measured outputs.
        exempt: None where inexact laws of its effects can't explain what it leaves. Where they may, the forms that are
            accepted all the same; of any other one it is required that only noise is left.
    """

    def __init__(
        self,
        before: Trial,
        base: Trial,
        noise: MeasurementNoise,
        *,
        exempt: Sequence[type[Effect]] | None = None,
    ) -> None:
        self.before, self.base, self.noise, self.exempt = before, base, noise, exempt

    def imperfection(self, trial: Trial, name: str) -> float:
        """What a further effect must remove at least: more than the other effects' laws may leave, as a share of what
        they have removed.

        A law that is replaced has none, nor have laws where the further effect leaves only noise.

        Args:
            trial: the model with the further effect.
            name: of that effect.
        """
        completes = leaves_white_noise(trial.training) and not leaves_white_noise(self.before.training)
        if completes or name in {form.name for form in self.exempt or ()}:
            return 0.0
        there = {e.name for e in trial.model.effects}
        return RULES.law_errors * imperfection(e for e in self.before.model.effects if e.name in there)

    @cached_property
    def left(self) -> NoiseModel | None:
        """Fitted noise model of the current model: coloured sensor noise and torque noise; None where it diverges."""
        return self._noise_of(self.before, self.noise)

    def _noise_of(self, trial: Trial, noise: MeasurementNoise) -> NoiseModel | None:
        known = {"predictable": RULES.innovations, "residual": self.before.training.covariance}
        return noise_model(trial.training, noise.covariance, **known)

    def over_noise(self, trial: Trial) -> float:
        """Log likelihood ratio [nats] of a model against the current one, each with its own noise model.

        The penalty of its further parameters (Schwarz 1978) is subtracted. The ratio is infinite where noise does not
        explain the current model's residual.

        Where the estimate of the measurement noise beside the model is the smaller one, both have that as well: what
        the current model lacks may have inflated and correlated the other.

        Args:
            trial: the model.
        """
        left = self.left
        if left is None or not is_noise(left):
            return np.inf
        noise = self.noise.and_beside(trial.training)
        smaller = [] if noise.covariance is self.noise.covariance else [noise]
        own = [self._noise_of(trial, known) for known in (self.noise, *smaller)]
        others = [left, *(self._noise_of(self.before, known) for known in smaller)]
        further = len(trial.training.free.paths) - len(self.before.training.free.paths)
        best, rival = (max((m.likelihood for m in of if m is not None), default=-np.inf) for of in (own, others))
        return best - rival - 0.5 * further * float(np.log(left.count))


def share_of_removed(trial: Trial, before: Trial, base: Trial) -> float:
    """Error that a further effect removes on selection data, over the influence of preceding effects (rms), of the
    output where it is largest; infinite for the first effect.

    The error of an inexact law is a share of its influence on each output. Friction may move the motor by thousands of
    times the encoder's noise, and the twist only a little.
    """
    return _share(before, base, np.diag(np.asarray(trial.held_out.covariance)))


def _share(before: Trial, base: Trial, left: Float[np.ndarray, " outputs"]) -> float:
    """The ratio for given remaining mean squares, as in [`share_of_removed`][]."""
    if before is base:
        return np.inf
    fits = before.held_out, base.held_out
    followed = ~np.any([lost(fit) for fit in fits], axis=0)
    weight = np.asarray(before.held_out.problem.segments.weight)[followed, :, None]
    one, other = (np.where(weight > 0, np.asarray(fit.error)[followed], 0.0) for fit in fits)
    influence = np.sum(weight * (one - other) ** 2, axis=(0, 1)) / max(float(np.sum(weight)), 1.0)
    then = np.diag(np.asarray(before.held_out.covariance))
    return float(np.sqrt(np.max(np.maximum(then - left, 0.0) / np.maximum(influence, 1e-300))))


def is_plausible(trial: Trial, name: str) -> bool:
    """Whether all parameters of an effect are within the range of real drives. Always true for a reduced log, whose
    units are arbitrary."""
    if isinstance(trial.model, ReducedModel):
        return True
    own = [known for path, known in trial.model.parameters().items() if path.startswith(f"{name}.")]
    return not any(info.implausibly_large(float(value)) for value, info in own)
