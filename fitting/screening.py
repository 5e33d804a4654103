"""A first look at the whole catalogue: what would each effect explain, to first order?

At zero strength an effect changes nothing, but the derivative of the simulated outputs with respect to its strength is
there, inside the equations of motion and all of them in one program. Least squares on those derivatives gives each
effect's strength and gain to first order (a score test), on held-out data too. The same linear algebra applied to
surrogates of the residual gives the law of the best gain where there is nothing to find.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.fft import prev_fast_len

from fitting.arrow import project
from fitting.estimate import STEP_ANGLE, Fit, suggested_substeps
from fitting.experiment import scales
from fitting.free import FreeParameters, base_paths, effect_paths, strength_paths
from fitting.residual import Problem, Unknowns, blocks
from hdjax import Model, ReducedModel
from hdjax.effects import CATALOGUE, Effect
from hdjax.lanes import jit_lanes

DRAWS = 199
"""Surrogate residuals; the smallest p-value that they can show is 1/200."""


class Lead(eqx.Module):
    """One form of an effect, as the first look sees it.

    Attributes:
        effect: the form at the strengths that suit best to first order.
        drive_changes: change of the parameters that were free already, by path.
        gain: decrease of the objective on held-out data, to first order.
    """

    effect: Effect
    drive_changes: dict[str, float]
    gain: float


class Screen(eqx.Module):
    """The first look at the whole catalogue.

    Attributes:
        leads: best first.
        null_gains: the best gain over the catalogue in each of the surrogates.
    """

    leads: tuple[Lead, ...]
    null_gains: Float[np.ndarray, " draws"]

    def p_value(self, gain: float) -> float:
        """How often chance alone makes the best of the catalogue at least this good."""
        return (1 + int(np.sum(self.null_gains >= gain))) / (1 + self.null_gains.size)


def screen(
    training: Fit,
    held_out: Fit,
    *,
    catalogue: Sequence[type[Effect]] = CATALOGUE,
    seed: int = 0,
) -> Screen:
    """Look at every form that the current model lacks.

    Args:
        training: fit of the current model.
        held_out: the same model's parameters on held-out stretches (states fitted, parameters held).
        catalogue: forms to look at.
        seed: of the surrogates.
    """
    model = training.model
    motion = scales(training.stretches)
    forms = [f for f in catalogue if not (f.needs_motor and isinstance(model, ReducedModel))]
    present = {e.name for e in model.effects}
    proposals = {f.name: f.proposals(motion) for f in forms}
    free_now = list(base_paths(model))
    for effect in model.effects:
        free_now += effect_paths(effect)
    drawn = jnp.asarray(surrogates(training, seed)), jnp.asarray(surrogates(held_out, seed + 1))
    leads: dict[str, Lead] = {}
    null_gains = np.full(DRAWS, -np.inf)
    for turn in range(max(len(p) for p in proposals.values())):
        effects = tuple(
            model.effect(f.name) if f.name in present else proposals[f.name][min(turn, len(proposals[f.name]) - 1)]
            for f in forms
        )
        everything = eqx.tree_at(lambda m: m.effects, model, effects)
        paths, fitted = _score(everything, training, drawn[0])
        _, unseen = _score(everything, held_out, drawn[1])
        index = {p: i for i, p in enumerate(paths)}
        nuisance = [index[p] for p in free_now]
        for effect in effects:
            if effect.name in present or turn >= len(proposals[effect.name]):
                continue
            own = [index[p] for p in strength_paths(effect)]
            positive = [i for i in own if everything.parameters()[paths[i]][1].positive]
            step, gain = _linear_gain(fitted, unseen, nuisance, own, positive)
            null_gains = np.maximum(null_gains, _null_gains(fitted, unseen, nuisance, own))
            if effect.name in leads and leads[effect.name].gain >= gain:
                continue
            strengths = {paths[i]: float(everything.get(paths[i])) + step[i] for i in own}
            filled = everything.replace(strengths).effect(effect.name)
            changes = {paths[i]: step[i] for i in nuisance}
            leads[effect.name] = Lead(filled, changes, gain)
    ordered = sorted(leads.values(), key=lambda lead: -lead.gain)
    return Screen(tuple(ordered), null_gains)


class _Score(eqx.Module):
    """Inner products of sensitivities with each other, with the residual, and with its surrogates.

    Attributes:
        gram: of the projected columns.
        gradient: columns against the residual.
        surrogate_gradients: columns against each surrogate.
        rows: number of measured values.
    """

    gram: np.ndarray
    gradient: np.ndarray
    surrogate_gradients: np.ndarray
    rows: float


def _score(everything: Model, fit: Fit, surrogates: Array) -> tuple[tuple[str, ...], _Score]:
    paths = list(base_paths(everything))
    for effect in everything.effects:
        paths += effect_paths(effect)
    known = everything.parameters()
    # Plain units: a strength of zero has no logarithm.
    free = FreeParameters(tuple(paths), (False,) * len(paths), jnp.ones(len(paths)))
    vector = jnp.stack([known[p][0] for p in paths])
    problem = Problem(
        everything,
        free,
        fit.problem.segments,
        fit.problem.whitening,
        jnp.ones(len(paths)),
        jnp.ones(len(everything.state_names)),
        # A first-order look needs no finer sensitivities; the residual is the fit's own.
        substeps=suggested_substeps(everything, fit.stretches, step_angle=2 * STEP_ANGLE),
        unroll=False,
    )
    unknowns = Unknowns(vector, _states(everything, fit))
    residual = jnp.asarray(fit.error) @ fit.problem.whitening.T
    gram, gradient, against = _inner_products(problem, unknowns, residual, surrogates)
    weight = fit.problem.segments.weight
    rows = float(jnp.sum(weight)) * fit.problem.segments.measured.shape[-1]
    return tuple(paths), _Score(np.asarray(gram), np.asarray(gradient), np.asarray(against), rows)


def _states(everything: Model, fit: Fit) -> Array:
    """The fit's initial states, with those of the effects that it does not have at rest."""
    known = dict(zip(fit.model.state_names, fit.unknowns.states.T, strict=True))
    rest = dict(zip(everything.state_names, everything.rest(), strict=True))
    segments = fit.unknowns.states.shape[0]
    columns = [known.get(n, jnp.full(segments, rest[n])) for n in everything.state_names]
    return jnp.stack(columns, axis=1)


@jit_lanes
def _inner_products(problem: Problem, unknowns: Unknowns, error: Array, surrogates: Array):
    found = blocks(problem, unknowns)
    columns = project(found, problem.segments.joined)
    # Residuals are measured minus simulated: what a strength explains is minus its derivative.
    columns = -columns[:, : surrogates.shape[2]]
    residual = error.reshape(error.shape[0], -1)
    gram = jnp.einsum("srp,srq->pq", columns, columns)
    gradient = jnp.einsum("srp,sr->p", columns, residual)
    return gram, gradient, jnp.einsum("srp,dsr->pd", columns, surrogates)


def surrogates(fit: Fit, seed: int) -> Float[np.ndarray, "draws segments rows"]:
    """Residuals with the same spectra and cross-spectra and random phases: noise of the residual's own colour."""
    random = np.random.default_rng(seed)
    weight = np.asarray(fit.problem.segments.weight) > 0
    error = np.asarray(fit.error) @ np.asarray(fit.problem.whitening).T
    series = error[weight].T
    samples = series.shape[1]
    length = prev_fast_len(samples, real=True)
    spectrum = np.fft.rfft(series[:, :length])
    found = np.zeros((DRAWS, *error.shape))
    for draw in range(DRAWS):
        turn = np.exp(1j * random.uniform(0.0, 2 * np.pi, spectrum.shape[1]))
        # Noise has no mean; what mean there is may be the very thing that is looked for.
        turn[0] = 0.0
        surrogate = np.fft.irfft(spectrum * turn[None, :], n=length)
        found[draw][weight] = np.resize(surrogate.T, (samples, series.shape[0]))
    return found.reshape(DRAWS, error.shape[0], -1)


def _linear_gain(
    fitted: _Score, unseen: _Score, nuisance: list[int], own: list[int], positive: list[int]
) -> tuple[dict[int, float], float]:
    """Least-squares step of the columns, and what it gains on unseen data beyond refitting what was free already.

    A strength that can't be negative is left at zero where it would be.
    """
    kept = list(own)
    while True:
        chosen = nuisance + kept
        step = _solve(fitted.gram, fitted.gradient[:, None], chosen)[:, 0]
        wrong = [i for i in kept if i in positive and step[i] < 0]
        if not wrong:
            break
        kept = [i for i in kept if i not in wrong]
    reference = _solve(fitted.gram, fitted.gradient[:, None], nuisance)[:, 0]
    gain = _loss(unseen, reference[:, None]) - _loss(unseen, step[:, None])
    return dict(enumerate(step.tolist())), float(gain[0] / (2 * unseen.rows))


def _null_gains(fitted: _Score, unseen: _Score, nuisance: list[int], own: list[int]) -> np.ndarray:
    """[`_linear_gain`][] of each surrogate."""
    reference = _solve(fitted.gram, fitted.surrogate_gradients, nuisance)
    step = _solve(fitted.gram, fitted.surrogate_gradients, nuisance + own)
    before = _loss(unseen, reference, unseen.surrogate_gradients)
    after = _loss(unseen, step, unseen.surrogate_gradients)
    return (before - after) / (2 * unseen.rows)


def _solve(gram: np.ndarray, gradient: np.ndarray, chosen: list[int]) -> np.ndarray:
    """Least squares over the chosen columns; zero for the others."""
    part = gram[np.ix_(chosen, chosen)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(part), 1e-300))
    scaled = part * np.outer(scale, scale)
    solution = np.zeros_like(gradient)
    inverse = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True)
    solution[chosen] = scale[:, None] * (inverse @ (scale[:, None] * gradient[chosen]))
    return solution


def _loss(score: _Score, step: np.ndarray, gradient: np.ndarray | None = None) -> np.ndarray:
    """Change of the sum of squares by a step, for each column of it."""
    against = score.gradient[:, None] if gradient is None else gradient
    return -2 * np.sum(step * against, axis=0) + np.sum(step * (score.gram @ step), axis=0)
