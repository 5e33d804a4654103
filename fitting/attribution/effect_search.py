"""Stepwise search for effects: add the best one, refit, repeat; then drop those that later ones make superfluous."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import equinox as eqx

from fitting.attribution.candidate_fit import Trial, attempt, continued, halo_for
from fitting.attribution.candidate_refit import under_best_hold
from fitting.attribution.rivals_again import compare_again
from fitting.attribution.rules import RULES
from fitting.attribution.selection_round import Round, look
from fitting.attribution.study import Data, Setting, Study
from fitting.attribution.support import Standing, leaves_imperfection
from fitting.errors import DataError
from fitting.estimation.base_fit import base_fit, is_held, leaves_white_noise
from fitting.estimation.encoder_delay import delay_of_load
from fitting.estimation.estimate import mostly_lost
from fitting.estimation.outliers import with_weights
from fitting.uncertainty.identifiability import parameters_at_bounds
from fitting.uncertainty.measurement_noise import MeasurementNoise, measurement_noise
from fitting.uncertainty.one_side import leaves_only_noise, with_mesh_priors
from hdjax import Hold, Model
from hdjax.effects import Effect


class Search(eqx.Module):
    """Result of the search for effects.

    Attributes:
        named: the model with the accepted effects.
        rounds: of the search.
        dropped: names of accepted effects that later ones made superfluous.
        without: the model without each of the kept effects.
        noise: of the measured outputs, where it was estimated.
        compared: the rounds of the kept effects, with ties compared in the final model.
        limited: whether the largest number of effects ended it.
    """

    named: Trial
    rounds: tuple[Round, ...]
    dropped: tuple[str, ...] = eqx.field(static=True)
    without: dict[str, Trial]
    noise: MeasurementNoise
    compared: tuple[Round, ...]
    limited: bool = eqx.field(static=True)


def base_trial(model: Model, data: Data, hold: Hold | None) -> tuple[Trial, Study]:
    """The base model fitted under the stated or the best hold, and a study of the data without its outliers.

    Args:
        model: the base model; its stiffness and damping are only placeholders.
        data: the stretches.
        hold: inter-sample behaviour of the torque, where the user states it.

    Raises:
        DataError: no oscillator fits the data.
    """
    first = hold if hold is not None else next(iter(data))
    training = data[first][0]
    best, side = base_fit(model, training, halo=halo_for(training))
    data = {h: (with_weights(t, best.stretches), v) for h, (t, v) in data.items()}
    study = Study(data, Setting(best.segmentation), load_late=delay_of_load(model, training))
    holds: list[Hold] = list(data) if hold is None else [hold]
    model = best.model
    if side is not None and leaves_only_noise(side, best, most=RULES.excess):
        model, study = with_mesh_priors(model, side), replace(study, side=side)
    trials = [attempt(model, study, h, hold_parameters=is_held(best)) for h in holds]
    chosen = min(trials, key=lambda t: t.training.objective)
    finer = study.fine_enough(chosen.training)
    if finer is not study:
        chosen = attempt(chosen.model, finer, chosen.hold, start=chosen, hold_parameters=is_held(best))
    if mostly_lost(chosen.training):
        raise DataError(
            "the simulated drive diverges for every stiffness and damping; check the inertias in the drive file, and "
            "unit, sign and side of the torque column"
        )
    return chosen, finer


def search_effects(
    base: Trial, study: Study, *, max_effects: int, catalogue: Sequence[type[Effect]], hold: Hold | None = None
) -> Search:
    """Add effects until the data support no further one.

    Args:
        base: the model without effects.
        study: the data and their segmentation.
        max_effects: effects to add at most.
        catalogue: candidate forms.
        hold: inter-sample behaviour of the torque, where the user states it; else the one that suits the effects best.
    """
    current, rounds, noise, limited = base, [], measurement_noise(base.training), False
    while len(rounds) - len(_replaced(rounds)) < max_effects:
        offered, exempt = catalogue, None
        if rounds:
            enough, noise = leaves_imperfection(current, base, noise)
            exempt = study.beside_imperfect(current.training, catalogue) if enough else None
            if enough and leaves_white_noise(current.training):
                if not exempt:
                    break
                offered = exempt
        turn = replace(study, seed=study.seed + len(rounds))
        this = look(Standing(current, base, noise, exempt=exempt), turn, catalogue=offered)
        rounds.append(this)
        if not this.accepted:
            break
        assert this.winner.trial is not None
        study = study.with_substeps(this.winner.trial.training.substeps)
        # Continue the fit: a remainder that has not converged would be taken for a further effect.
        current = continued(this.winner.trial, study)
        study.progress(f"found {this.winner.name}")
    else:
        limited = True
    if hold is None and current is not base:
        current = under_best_hold(current, study)
    dropped = [*_holds_given_up(rounds, base.hold, current.hold), *_replaced(rounds)]
    accepted = [this.winner.name for this in rounds if this.accepted and this.winner.name not in dropped]
    current, superfluous, without = _without_superfluous(accepted, current, base, study)
    dropped += superfluous
    kept = [this for this in rounds if this.accepted and this.winner.name not in dropped]
    current, compared, instead = compare_again(kept, current, study)
    if instead:
        rounds, again = [*rounds, *instead.values()], {this.winner.name for this in instead.values()}
        # A form that was dropped may come back in the place of another one.
        dropped = [name for name in (*dropped, *instead) if name not in again]
        kept = [instead[name] if (name := this.winner.name) in instead else this for this in kept]
        # Beside a better law another effect may explain nothing.
        names = [this.winner.name for this in kept]
        current, superfluous, without = _without_superfluous(names, current, base, study)
        dropped += superfluous
        kept, compared = ([r for r in some if r.winner.name not in superfluous] for some in (kept, compared))
    for name in (this.winner.name for this in kept if this.winner.name not in without):
        alone = len(kept) == 1 and current.hold == base.hold
        without[name] = base if alone else refitted_without([name], current, base, study)
    return Search(current, tuple(rounds), tuple(dropped), without, noise, tuple(compared), limited)


def _without_superfluous(
    names: Sequence[str], current: Trial, base: Trial, study: Study
) -> tuple[Trial, list[str], dict[str, Trial]]:
    """The model without superfluous effects, their names, and the model without each of the others. An effect, or a
    hold, is superfluous if its removal hardly changes the error on selection data. The last one may be as well, where
    the others were completed beside it. An effect with a parameter that has ended at a bound since is dropped in any
    case.

    Args:
        names: of what was accepted, in that order.
        current: the model.
        base: the model without effects.
        study: the data and their segmentation.
    """
    effects = {e.name for e in current.model.effects}
    dropped = [name for name in names if name in effects and parameters_at_bounds(current.model, name)]
    if dropped:
        current = base if len(dropped) == len(names) else refitted_without(dropped, current, base, study)
    without, names = {}, [name for name in names if name not in dropped]
    for name in names if len(names) > 1 else ():
        poorer = refitted_without([name], current, base, study)
        if poorer.held_out.objective - current.held_out.objective < RULES.least_gain:
            dropped.append(name)
            current, without = poorer, {}
        else:
            without[name] = poorer
    return current, dropped, without


def _replaced(rounds: Sequence[Round]) -> list[str]:
    """Accepted effects that a later one replaces."""
    models = [(this.before.model, this.winner.trial.model) for this in rounds if this.accepted and this.winner.trial]
    return [e.name for before, after in models for e in before.effects if e.name not in {f.name for f in after.effects}]


def _holds_given_up(rounds: Sequence[Round], first: Hold, last: Hold) -> list[str]:
    """Accepted holds of the torque that the final model does not have, or that the base model has."""
    winners = [(this.winner, this.before) for this in rounds if this.accepted]
    changes = [(w.name, w.trial.hold) for w, before in winners if w.trial and w.trial.hold != before.hold]
    given_up = changes[:-1] if last != first and changes and changes[-1][1] == last else changes
    return [name for name, _ in given_up]


def refitted_without(names: Collection[str], current: Trial, base: Trial, study: Study) -> Trial:
    """The model refitted without some of its effects, with the same solver steps.

    Args:
        names: of effects; any other name is that of a hold, which is reverted.
        current: the model.
        base: the model without effects.
        study: the data and their segmentation.
    """
    model, effects = current.model, {e.name for e in current.model.effects}
    for name in effects.intersection(names):
        model = model.without_effect(name)
    hold = current.hold if effects.issuperset(names) else base.hold
    return attempt(model, study.with_substeps(current.training.substeps), hold, start=current)
