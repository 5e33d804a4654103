"""A first look at the whole catalogue: what would each effect explain, to first order?

At zero strength an effect changes nothing, but the derivative of the simulated outputs with respect to its strength is
there: the answer of the present model to a small force along its own motion. Least squares on those derivatives gives
each effect's strength and gain to first order (a score test), on held-out data too. The same linear algebra applied to
surrogates of the residual gives the law of the best gain where there is nothing to find.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.fft import prev_fast_len

from fitting.along import Along, along
from fitting.estimate import Fit, lost
from fitting.experiment import Segments, scales
from fitting.explained import explained, solved
from fitting.followed import Followed, follow
from fitting.free import strength_paths
from fitting.posing import STEP_ANGLE, suggested_substeps
from fitting.regressors import Memory, Regressors, regressors
from fitting.residual import Blocks, Problem
from fitting.solve import linearise
from fitting.spectral_lines import STANDS_OUT, spectral_lines, surroundings
from hdjax import TwoInertiaModel
from hdjax.effects import CATALOGUE, Effect, applicable
from hdjax.program_cache import jit_kept
from hdjax.where import where

_Item = TypeVar("_Item")
_Found = TypeVar("_Found")
DRAWS = 199
"""Surrogate residuals; the smallest p-value that they can show is 1/200."""

# Forms that are looked at at a time.
_BEFOREHAND = 2
# Columns that one program takes at once; as many proposals as fit share it.
_COLUMNS = 16


class Lead(eqx.Module):
    """One form of an effect, as the first look sees it.

    Attributes:
        effect: the form at the strengths that suit best to first order.
        drive_changes: change of the parameters that were free already, by path.
        gain: decrease of the objective on held-out data, to first order.
        own_states: where the effect's own states start in each training segment, driven by the present model's motion;
            None for an effect without.
    """

    effect: Effect
    drive_changes: dict[str, float]
    gain: float
    own_states: Float[np.ndarray, "segments own"] | None = None


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
    sights = _sight(training, seed), _sight(held_out, seed + 1)
    for batch in _batches(sights, proposals, _follow_on(training, held_out)):
        fitted, unseen = (_score(*pair) for pair in zip(sights, batch.forces, strict=True))
        for index, own in batch.columns.items():
            columns = [len(free_now) + c for c in own]
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
            leads[effect.name] = Lead(filled, changes, gain, batch.own_states[index])
    ordered = sorted(leads.values(), key=lambda lead: -lead.gain)
    return Screen(tuple(ordered), null_gains)


def screen_ahead(training: Fit) -> None:
    """Have the program that follows a model's motion made beside what else is done, before [`screen`][] asks for it."""
    follow.prepare(_looked_at(training), training.unknowns)


def _looked_at(fit: Fit) -> Problem:
    """What a fit has solved, at its solution."""
    # Held-out fits hold their parameters; here all of them count. A first-order look needs no finer sensitivities
    # than this; the residual is the fit's own.
    return replace(
        fit.problem,
        model=fit.model,
        active=jnp.ones_like(fit.problem.active),
        substeps=suggested_substeps(fit.model, fit.stretches, step_angle=2 * STEP_ANGLE),
    )


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


class _Sight(eqx.Module):
    """A fit's motion, and its residual in the form that inner products take.

    Attributes:
        seen: the motion as effects look at it.
        found: the residual's derivatives by what is free already, in physical units.
        whitening: of the outputs.
        residual: whitened.
        surrogates: of it.
    """

    seen: Along
    found: Blocks
    whitening: Float[Array, "outputs outputs"]
    residual: Float[Array, "segments samples outputs"]
    surrogates: Float[Array, "draws segments rows"]


def _sight(fit: Fit, seed: int) -> _Sight:
    problem = _looked_at(fit)
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
    seen = along(fit.model, followed, segments, fit.stretches)
    return _Sight(seen, found, whitening, residual, jnp.asarray(surrogates(fit, seed)))


def _score(sight: _Sight, forces: Regressors) -> _Score:
    seen = sight.seen
    rows = float(np.sum(seen.segments.weight)) * sight.residual.shape[-1]
    products = _inner_products(
        sight.found, seen.followed, seen.segments, sight.whitening, forces, sight.residual, sight.surrogates
    )
    gram, gradient, against = (np.asarray(a) for a in products)
    return _Score(gram, gradient, against, rows)


def _follow_on(training: Fit, held_out: Fit) -> bool:
    """Whether each held-out stretch begins where a training stretch ends."""
    ends = [(s.name, s.stop) for s in training.stretches]
    return ends == [(s.name, s.start) for s in held_out.stretches]


def _on_host(tree):
    """Arrays by way of the host: what follows is not shared among devices."""
    return jax.tree.map(lambda a: jnp.asarray(np.asarray(a)) if eqx.is_array(a) else a, tree)


class _Batch(eqx.Module):
    """Proposals that one program takes at once.

    Attributes:
        columns: of each proposal, by its place in the list.
        forces: regressors along the training motion and along the held-out one.
        own_states: where each proposal's own states start in each training segment; None where it has none.
    """

    columns: dict[int, list[int]]
    forces: tuple[Regressors, Regressors]
    own_states: dict[int, np.ndarray | None]


def _batches(sights: tuple[_Sight, _Sight], proposals: Sequence[Effect], follow_on: bool) -> Iterator[_Batch]:
    """Regressors of the proposals, as many as go into one program."""

    def looked_at(same: Sequence[Effect]) -> tuple[Regressors, Regressors, Memory | None]:
        fitted, memory = regressors(sights[0].seen, same)
        unseen, _ = regressors(sights[1].seen, same, memory if follow_on else None)
        return fitted, unseen, memory

    columns: dict[int, list[int]] = {}
    own: dict[int, np.ndarray | None] = {}
    waiting: list[tuple[Regressors, Regressors]] = []
    taken, index = 0, 0
    forms = dict.fromkeys(type(p) for p in proposals)
    alike = [[p for p in proposals if type(p) is form] for form in forms]
    for same, (*found, memory) in zip(alike, _beforehand(looked_at, alike), strict=True):
        strengths = len(strength_paths(same[0]))
        for i in range(len(same)):
            if waiting and taken + strengths > _COLUMNS:
                yield _Batch(columns, _filled(waiting), own)
                columns, own, waiting, taken = {}, {}, [], 0
            mine = slice(i * strengths, (i + 1) * strengths)
            waiting.append(jax.tree.map(lambda a, mine=mine: a[..., mine], tuple(found)))
            columns[index] = list(range(taken, taken + strengths))
            own[index] = None if memory is None else memory.at_starts[..., i]
            taken, index = taken + strengths, index + 1
    if waiting:
        yield _Batch(columns, _filled(waiting), own)


def _beforehand(find: Callable[[_Item], _Found], items: Sequence[_Item]) -> Iterator[_Found]:
    """What is found of each item in turn, the next two while the last one is used: each form has a program of its own
    to be compiled."""
    with ThreadPoolExecutor(_BEFOREHAND) as workers:
        coming: deque[Future[_Found]] = deque()
        for item in items:
            coming.append(workers.submit(find, item))
            if len(coming) > _BEFOREHAND:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()


def _filled(parts: Sequence[tuple[Regressors, Regressors]]) -> tuple[Regressors, Regressors]:
    """The parts side by side, with columns of zeros up to the next size that has a program."""
    missing = -sum(part.reading.shape[-1] for part, _ in parts) % _COLUMNS

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
