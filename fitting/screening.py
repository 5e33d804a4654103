"""A first look at the whole catalogue: what would each effect explain, to first order?

At zero strength an effect changes nothing, but the derivative of the simulated outputs with respect to its strength is
there: the answer of the present model to a small force along its own motion. Least squares on those derivatives gives
each effect's strength and gain to first order (a score test), on held-out data too. The same linear algebra applied to
surrogates of the residual gives the law of the best gain where there is nothing to find.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.fft import prev_fast_len

from fitting.along import Along, along
from fitting.estimate import STEP_ANGLE, Fit, lost, suggested_substeps
from fitting.experiment import Segments, scales
from fitting.explained import explained, solved
from fitting.followed import Followed, follow
from fitting.free import strength_paths
from fitting.regressors import Regressors, regressors
from fitting.residual import Blocks
from fitting.solve import linearise
from fitting.spectral_lines import STANDS_OUT, spectral_lines, surroundings
from hdjax import TwoInertiaModel
from hdjax.effects import CATALOGUE, Effect, applicable
from hdjax.program_cache import jit_kept
from hdjax.where import where

DRAWS = 199
"""Surrogate residuals; the smallest p-value that they can show is 1/200."""

# Columns that one program takes at once; as many proposals as fit share it.
_COLUMNS = 16


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
    present = {e.name for e in model.effects}
    found = applicable(
        [form for form in catalogue if form.name not in present],
        replace(scales(training.stretches, model), residual_frequencies=spectral_lines(training)),
        has_motor=isinstance(model, TwoInertiaModel),
    )
    proposals = tuple(effect for effects in found.values() for effect in effects)
    free_now = training.free.paths
    leads: dict[str, Lead] = {}
    null_gains = np.full(DRAWS, -np.inf)
    looks = zip(_scores(training, proposals, seed), _scores(held_out, proposals, seed + 1), strict=True)
    for (own, fitted), (_, unseen) in looks:
        for index, columns in own.items():
            effect = proposals[index]
            paths = strength_paths(effect)
            info = model.with_effects(effect).parameters()
            positive = [c for c, p in zip(columns, paths, strict=True) if info[p][1].positive]
            nuisance = list(range(len(free_now)))
            step, gain = _linear_gain(fitted, unseen, nuisance, columns, positive)
            null_gains = np.maximum(null_gains, _null_gains(fitted, unseen, nuisance, columns))
            if effect.name in leads and leads[effect.name].gain >= gain:
                continue
            strengths = {p: float(info[p][0]) + step[c] for c, p in zip(columns, paths, strict=True)}
            filled = model.with_effects(effect).replace(strengths).effect(effect.name)
            changes = {p: step[i] for i, p in enumerate(free_now)}
            leads[effect.name] = Lead(filled, changes, gain)
    ordered = sorted(leads.values(), key=lambda lead: -lead.gain)
    return Screen(tuple(ordered), null_gains)


class _Score(eqx.Module):
    """Inner products of sensitivities with each other, with the residual, and with its surrogates.

    Attributes:
        gram: of the projected columns: of what was free already, then of strengths.
        gradient: columns against the residual.
        surrogate_gradients: columns against each surrogate.
        rows: number of measured values.
    """

    gram: np.ndarray
    gradient: np.ndarray
    surrogate_gradients: np.ndarray
    rows: float


def _scores(fit: Fit, proposals: Sequence[Effect], seed: int) -> Iterator[tuple[dict[int, list[int]], _Score]]:
    """The proposals' inner products, a few proposals at a time: each one's columns, and the score that has them."""
    # Held-out fits hold their parameters; here all of them count. A first-order look needs no finer sensitivities
    # than this; the residual is the fit's own.
    problem = replace(
        fit.problem,
        model=fit.model,
        active=jnp.ones_like(fit.problem.active),
        substeps=suggested_substeps(fit.model, fit.stretches, step_angle=2 * STEP_ANGLE),
    )
    followed: Followed = _on_host(follow(problem, fit.unknowns))
    found: Blocks = _on_host(linearise(problem, fit.unknowns))
    slopes = fit.free.slopes(fit.model)[None, None, :]
    found = replace(
        found,
        by_parameter=found.by_parameter / slopes,
        before_by_parameter=found.before_by_parameter / slopes,
    )
    segments: Segments = _on_host(problem.segments)
    whitening = _on_host(problem.whitening)
    residual = _on_host(fit.error) @ whitening.T
    # Where the model runs away there is no motion to look along.
    kept = jnp.asarray(~lost(fit) & np.isfinite(np.asarray(followed.transition)).all(axis=(1, 2, 3)))
    followed = jax.tree.map(lambda a: where(kept.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0), followed)
    segments = replace(segments, weight=where(kept[:, None], segments.weight, 0.0))
    residual = where(kept[:, None, None], residual, 0.0)
    drawn = jnp.asarray(surrogates(fit, seed))
    rows = float(np.sum(segments.weight)) * residual.shape[-1]
    already = slopes.size
    for own, forces in _batches(along(fit.model, followed, segments), proposals):
        products = _inner_products(found, followed, segments, whitening, forces, residual, drawn)
        gram, gradient, against = (np.asarray(a) for a in products)
        yield (
            {i: [already + c for c in columns] for i, columns in own.items()},
            _Score(gram, gradient, against, rows),
        )


def _on_host(tree):
    """Arrays by way of the host: what follows is not shared among devices."""
    return jax.tree.map(lambda a: jnp.asarray(np.asarray(a)) if eqx.is_array(a) else a, tree)


def _batches(seen: Along, proposals: Sequence[Effect]) -> Iterator[tuple[dict[int, list[int]], Regressors]]:
    """Regressors of the proposals, as many as go into one program; the columns of each, by its place in the list."""
    own: dict[int, list[int]] = {}
    waiting: list[Regressors] = []
    taken, index = 0, 0
    for form in dict.fromkeys(type(p) for p in proposals):
        same = [p for p in proposals if type(p) is form]
        found = regressors(seen, same)
        strengths = len(strength_paths(same[0]))
        for i in range(len(same)):
            if waiting and taken + strengths > _COLUMNS:
                yield own, _filled(waiting)
                own, waiting, taken = {}, [], 0
            mine = slice(i * strengths, (i + 1) * strengths)
            waiting.append(jax.tree.map(lambda a, mine=mine: a[..., mine], found))
            own[index] = list(range(taken, taken + strengths))
            taken, index = taken + strengths, index + 1
    if waiting:
        yield own, _filled(waiting)


def _filled(parts: Sequence[Regressors]) -> Regressors:
    """The parts side by side, with columns of zeros up to the next size that has a program."""
    missing = -sum(part.reading.shape[-1] for part in parts) % _COLUMNS

    def joined(*columns: np.ndarray) -> np.ndarray:
        return np.concatenate([*columns, np.zeros((*columns[0].shape[:-1], missing))], axis=-1)

    return jax.tree.map(joined, *parts)


@jit_kept
def _inner_products(
    found: Blocks,
    followed: Followed,
    segments: Segments,
    whitening: Float[Array, "outputs outputs"],
    forces: Regressors,
    residual: Float[Array, "segments samples outputs"],
    surrogates: Float[Array, "draws segments rows"],
) -> tuple[Float[Array, "columns columns"], Float[Array, " columns"], Float[Array, "columns draws"]]:
    columns = (jnp.asarray(a) for a in (forces.at_start, forces.at_end, forces.reading))
    explains = explained(found, followed, segments, whitening, *columns)
    flat = explains.reshape(-1, explains.shape[-1])
    return (
        flat.T @ flat,
        flat.T @ residual.reshape(-1),
        flat.T @ surrogates.reshape(surrogates.shape[0], -1).T,
    )


def surrogates(fit: Fit, seed: int) -> Float[np.ndarray, "draws segments rows"]:
    """Residuals with the same spectra and cross-spectra and random phases: noise of the residual's own colour.

    A line that stands out of its surroundings is no colour of noise, but what a periodic effect would leave: with a
    phase of its own it would still be explained by that effect.
    """
    random = np.random.default_rng(seed)
    weight = np.asarray(fit.problem.segments.weight) > 0
    error = np.asarray(fit.error) @ np.asarray(fit.problem.whitening).T
    series = error[weight].T
    samples = series.shape[1]
    length = prev_fast_len(samples, real=True)
    spectrum = np.fft.rfft(series[:, :length])
    power = np.sum(np.abs(spectrum) ** 2, axis=0)
    spectrum = spectrum / np.sqrt(np.maximum(power / (STANDS_OUT * surroundings(power)), 1.0))
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
    solution = np.zeros_like(gradient)
    solution[chosen] = solved(gram[np.ix_(chosen, chosen)], gradient[chosen])
    return solution


def _loss(score: _Score, step: np.ndarray, gradient: np.ndarray | None = None) -> np.ndarray:
    """Change of the sum of squares by a step, for each column of it."""
    against = score.gradient[:, None] if gradient is None else gradient
    return -2 * np.sum(step * against, axis=0) + np.sum(step * (score.gram @ step), axis=0)
