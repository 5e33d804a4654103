"""What the data say of an effect that was refitted: its strength, what it removes, whether its values are plausible."""

from collections.abc import Collection
from functools import cached_property

import numpy as np
from jaxtyping import Float

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.case_evidence import NoiseEvidence
from fitting.attribution.decisions import only_noise
from fitting.attribution.rules import RULES, DecisionRules
from fitting.estimation.estimate import Fit
from fitting.estimation.free_parameters import effect_paths, strength_paths
from fitting.uncertainty.measurement_noise import MeasurementNoise
from fitting.uncertainty.noise_model import NoiseModel, noise_model
from fitting.uncertainty.normal_law import NORMAL_95
from fitting.uncertainty.standard_errors import Estimate, Uncertainty, uncertainty
from hdjax import ReducedModel
from hdjax.effects import Effect
from hdjax.parameters import own_parameters


def strength_errors(fit: Fit, names: Collection[str]) -> dict[str, float]:
    """By how many standard errors the best known strength of each effect differs from zero, of those that its name
    speaks of.

    With the effect's shape as fitted: where a strength is zero, its shape means nothing, and along a valley of shapes
    that explain the same (a creep's stiffness over its time) the strength may well be open.

    Args:
        fit: of the model.
        names: of effects to ask for.
    """
    if not names:
        return {}
    found = uncertainty(fit, torque_noise=False)
    return {name: _strength_errors(found, fit.model.effect(name)) for name in names}


def told_from_zero(fit: Fit, names: Collection[str], rules: DecisionRules = RULES) -> set[str]:
    """Those effects of a model of which the fit tells at least one strength from zero; arguments as in
    [`strength_errors`][]."""
    return {name for name, errors in strength_errors(fit, names).items() if errors > rules.strength_errors}


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
    """Of one strength, where only a part of its error is left; of a positive one those of its logarithm."""
    upper = estimate.ci95[1]
    if dict(own_parameters(effect))[estimate.path.split(".")[1]].positive:
        size, error = 1.0, part * float(np.log(max(upper / estimate.value, 1.0)))
    else:
        size, error = abs(estimate.value), part * (upper - estimate.value)
    return NORMAL_95 * size / max(error, 1e-300)


def imperfection(before: Trial) -> float:
    """Share (rms) of what a model's effects have removed that they may get wrong themselves."""
    return max((effect.imperfection for effect in before.model.effects), default=0.0)


def leaves_imperfection(before: Trial, base: Trial, noise: MeasurementNoise) -> tuple[bool, MeasurementNoise]:
    """Whether nothing is left beyond the measurement noise but what a model's effects may get wrong themselves, so
    that no further effect could remove more.

    Args:
        before: the model.
        base: the model without effects.
        noise: as far as fits have been asked for it.

    Returns:
        Whether it is so, and the noise, for which the model has been asked as well where it mattered: it may see less
        of it than the base model.
    """
    small = imperfection(before)
    if _share(before, base, np.diag(np.asarray(noise.covariance))) > small:
        return False, noise
    noise = noise.and_beside(before.training)
    return _share(before, base, np.diag(np.asarray(noise.covariance))) <= small, noise


def noise_evidence(left: NoiseModel) -> NoiseEvidence:
    """The same as decisions see it."""
    return NoiseEvidence(left.share, left.predictable, left.size)


def is_noise(left: NoiseModel | None) -> bool:
    """Whether what a model leaves may all be noise."""
    return left is not None and all(check.holds for check in only_noise(noise_evidence(left)))


def noise_of_torque(left: NoiseModel | None) -> float | None:
    """Standard deviation of the torque's noise [N m]; None where the sensors' noise alone explains as much."""
    return left.std if left is not None and left.likelihood - left.without > RULES.noise_gain else None


def _noise_of(trial: Trial, outputs: Float[np.ndarray, "outputs outputs"]) -> NoiseModel:
    return noise_model(trial.training, outputs, predictable=RULES.innovations)


class Standing:
    """A model with effects, and what a further one has to better.

    Attributes:
        before: the current model.
        base: the model without any effect.
        noise: of the measured outputs.
    """

    def __init__(self, before: Trial, base: Trial, noise: MeasurementNoise) -> None:
        self.before, self.base, self.noise = before, base, noise

    @cached_property
    def left(self) -> NoiseModel:
        """What the current model leaves as noise of the sensors, with a memory, and of the torque."""
        return _noise_of(self.before, np.asarray(self.noise.covariance))

    def over_noise(self, trial: Trial) -> float:
        """Log likelihood [nats] by which a model betters the current one, where each has a noise model of its own, less
        what its further parameters would gain on noise (Schwarz 1978). Infinite where noise is no explanation of what
        the current model leaves.

        Args:
            trial: the model.
        """
        left = self.left
        if not is_noise(left):
            return np.inf
        own = _noise_of(trial, np.asarray(self.noise.covariance))
        further = len(trial.training.free.paths) - len(self.before.training.free.paths)
        return own.likelihood - left.likelihood - 0.5 * further * float(np.log(left.count))


def share_of_removed(trial: Trial, before: Trial, base: Trial) -> float:
    """What a further effect removes of the error on selection data, over what the effects before it have removed (rms),
    of the output of which it is the most; infinite for the first one.

    What a form gets wrong is a share of what it does to each output: friction may turn the motor thousands of times
    farther than its encoder's noise, and the twist only a little.
    """
    return _share(before, base, _mean_squares(trial))


def _share(before: Trial, base: Trial, left: Float[np.ndarray, " outputs"]) -> float:
    """What it would take off the error if so little (mean squares) were left, as in [`share_of_removed`][]."""
    then, first = _mean_squares(before), _mean_squares(base)
    better = first > then
    if before is base or not np.any(better):
        return np.inf
    return float(np.sqrt(np.max(np.maximum(then - left, 0.0)[better] / (first - then)[better])))


def _mean_squares(trial: Trial) -> Float[np.ndarray, " outputs"]:
    """Of each output's error on selection data."""
    return np.diag(np.asarray(trial.held_out.covariance))


def is_plausible(trial: Trial, name: str) -> bool:
    """Whether no parameter of an effect is larger than real drives show; a reduced log's units are its own."""
    if isinstance(trial.model, ReducedModel):
        return True
    own = [known for path, known in trial.model.parameters().items() if path.startswith(f"{name}.")]
    return not any(info.implausibly_large(float(value)) for value, info in own)
