"""Prediction bands of free runs, from the uncertainty of parameters and initial state, and noise."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.engines import linearise, with_engine
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_run import FreeRun, free_run, whole_simulations
from fitting.estimation.initial_states import initial_states, window
from fitting.estimation.residual import Problem, Unknowns
from fitting.estimation.weighing import whitening
from fitting.uncertainty.noise_model import spread_by_torque
from fitting.uncertainty.normal_law import NORMAL_95
from fitting.uncertainty.standard_errors import Uncertainty


class PredictionBand(eqx.Module):
    """A free run and its uncertainty, to first order.

    Model discrepancy is not included: where a fit's residual exceeds the noise, so do prediction errors. For a run that
    begins at rest the band is too wide.

    Attributes:
        run: the free run.
        std_parameters: of the predicted principal output, due to the parameters' covariance, in its unit. The initial
            state is refitted to its window for each parameter value.
        std_state: due to the noise in that window.
        std_noise: of the measured one.
        std_torque: of the predicted one, due to torque noise.
    """

    run: FreeRun
    std_parameters: Float[np.ndarray, " n"]
    std_state: Float[np.ndarray, " n"]
    std_noise: float
    std_torque: Float[np.ndarray, " n"] | float = 0.0

    @property
    def std_predicted(self) -> Float[np.ndarray, " n"]:
        """Standard error of the predicted output."""
        return np.sqrt(self.std_parameters**2 + self.std_state**2 + self.std_torque**2)

    @property
    def std_measured(self) -> Float[np.ndarray, " n"]:
        """Standard deviation of measured minus predicted."""
        return np.hypot(self.std_predicted, self.std_noise)

    @property
    def band95(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Limits that contain 95 % of the measured samples."""
        reach = NORMAL_95 * self.std_measured
        return self.run.predicted - reach, self.run.predicted + reach

    @property
    def inside(self) -> Bool[np.ndarray, " n"]:
        """Which measured samples are in the band; none where the run diverged."""
        low, high = self.band95
        return (low <= self.run.measured) & (self.run.measured <= high)


def coverage(bands: Sequence[PredictionBand]) -> float:
    """Share of the valid samples of several runs in their bands; NaN where a band is unknown."""
    if not all(np.isfinite(b.std_predicted).all() for b in bands):
        return np.nan
    return float(np.mean(np.concatenate([b.inside[b.run.counts] for b in bands])))


def prediction_bands(
    fitted: Fit,
    found: Uncertainty,
    stretches: Sequence[Stretch],
    *,
    noise: Float[Array, "outputs outputs"],
    halo: int = 0,
    runs: Sequence[FreeRun] | None = None,
    torque_noise: float = 0.0,
) -> tuple[PredictionBand, ...]:
    """Free runs along stretches, with their bands.

    Args:
        fitted: the fitted model.
        found: its uncertainty.
        stretches: to simulate; outputs beyond the initial-state window are not used.
        noise: covariance of the outputs' measurement noise.
        halo: intervals of torque before the start, for delays.
        runs: the free runs along the stretches, if already computed.
        torque_noise: standard deviation of the noise of a torque sample [N m].
    """
    substeps = fitted.substeps
    if runs is None:
        runs = free_run(fitted.model, stretches, covariance=noise, halo=halo, substeps=substeps, like=fitted)
    setting = {"covariance": noise, "halo": halo, "substeps": substeps}
    states, _ = initial_states(fitted.model, stretches, **setting, like=fitted)
    whole = whole_simulations(fitted.model, fitted.free, stretches, halo, substeps)
    by_parameter, by_state = _slopes(whole, Unknowns(fitted.free.pack(fitted.model), states))
    driven = np.zeros(by_parameter.shape[:2])
    if torque_noise > 0.0:
        driven = spread_by_torque(with_engine(whole), Unknowns(fitted.free.pack(fitted.model), states), torque_noise)
    samples = window(fitted.model, stretches)
    windows = [stretch.beginning(samples).weight for stretch in stretches]
    if any(stretch.experiment.has_own_zero for stretch in stretches):
        # The zero is estimated like a state, and acts on the dynamic error alone.
        by_zero = np.zeros_like(by_state[..., :1])
        by_zero[[s.experiment.has_own_zero for s in stretches], :, -1] = 1.0
        by_state = np.concatenate((by_state, by_zero), axis=-1)
    return tuple(
        _band(run, by_parameter[i, :n], by_state[i, :n], driven[i, :n], noise, found.covariance, weight)
        for i, (run, n, weight) in enumerate(zip(runs, map(len, stretches), windows, strict=True))
    )


def _slopes(problem: Problem, unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Derivative of the simulated outputs by sample and output: with respect to parameters, and to initial states. A
    band is predicted for invalid samples as well."""
    problem = eqx.tree_at(lambda p: p.segments.weight, problem, replace_fn=jnp.ones_like)
    found = linearise(with_engine(problem), unknowns)
    count, samples, outputs = problem.segments.measured.shape
    shape = (count, samples, outputs, -1)
    by_parameter, by_state = (
        np.asarray(a)[:, : samples * outputs].reshape(shape) for a in (found.by_parameter, found.by_state)
    )
    # The residual is measured minus simulated.
    return -by_parameter, -by_state


def _band(
    run: FreeRun,
    by_parameter: np.ndarray,
    by_state: np.ndarray,
    driven: np.ndarray,
    noise: Float[Array, "outputs outputs"],
    covariance: np.ndarray,
    weight: np.ndarray,
) -> PredictionBand:
    """The band of one run, from the derivatives of its outputs, torque noise, and the weights of the samples in its
    initial-state window; NaN where they diverge."""
    std_noise = float(np.sqrt(noise[-1, -1]))
    if not (np.isfinite(by_parameter).all() and np.isfinite(by_state).all()):
        unknown = np.full(len(by_parameter), np.nan)
        return PredictionBand(run, unknown, unknown, std_noise, driven)
    own = np.asarray(whitening(noise)) * weight[:, None, None]
    seen = (own @ by_state[: weight.size]).reshape(-1, by_state.shape[2])
    moved = (own @ by_parameter[: weight.size]).reshape(-1, by_parameter.shape[2])
    # Scaled, since angles and rates differ by orders of magnitude; a hidden state that the window does not determine is
    # fixed.
    size = np.linalg.norm(seen, axis=0)
    size = np.where(size > 0, size, 1.0)
    inverse = np.linalg.pinv(seen / size, rcond=1e-10) / size[:, None]
    total = by_parameter[:, -1] - by_state[:, -1] @ (inverse @ moved)
    spread = by_state[:, -1] @ inverse
    return PredictionBand(
        run=run,
        std_parameters=np.sqrt(np.maximum(np.einsum("np,pq,nq->n", total, covariance, total), 0.0)),
        std_state=np.linalg.norm(spread, axis=1),
        std_noise=std_noise,
        std_torque=driven,
    )
