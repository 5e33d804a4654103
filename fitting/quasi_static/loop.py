"""The loop for quasi-static logs: fit the line, attribute its residual to an effect, add that, refit."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fitting.attribution.case_evidence import FinalEvidence
from fitting.attribution.decisions import Check, Outcome, conclude, support
from fitting.attribution.rules import RULES
from fitting.quasi_static.attribution import Held, TwistRound, TwistTrial, is_determined, look, torque_error
from fitting.quasi_static.form import Form
from fitting.quasi_static.leftover import Leftover, leftover
from fitting.quasi_static.motion_forms import motion_forms
from fitting.quasi_static.points import Points
from fitting.quasi_static.rests import RestAnalysis, analyse_rests
from fitting.quasi_static.torque_forms import torque_forms
from fitting.quasi_static.twist_model import TwistModel

# Most forms of one family in a model: orders of an angle, parallel sliders.
_MOST_OF_A_FAMILY = 4


@dataclass(frozen=True, eq=False)
class Finding:
    """An accepted family of effects.

    Attributes:
        family: Its name.
        forms: Its forms in the final model, in order of acceptance.
        validation_gain: Share of the held-out error that it removes, relative to the final model without it.
        p_value: Under the null distribution of the catalogue's best on noise.
        at_rest: The analysis of points at rest if it was found there; its figures are then from these. Else None.
    """

    family: str
    forms: tuple[Form, ...]
    validation_gain: float
    p_value: float
    at_rest: RestAnalysis | None = None


@dataclass(frozen=True, eq=False)
class QuasiStaticLoop:
    """Result of the loop on quasi-static logs.

    Attributes:
        decision: The conclusion.
        held: The points and their folds.
        before: The straight line.
        after: The final model; the same where nothing was found.
        findings: Largest gain first.
        rounds: Of the search.
        at_rest: The analysis of rests, or None where no joint rested.
        dropped: Accepted forms that a later one made superfluous.
        left: A dependence of the final residual, if any.
        forms_tried: Number of forms in the catalogue; zero without a search.
        checks: Every applied rule.
    """

    decision: Outcome
    held: Held
    before: TwistTrial
    after: TwistTrial
    findings: tuple[Finding, ...]
    rounds: tuple[TwistRound, ...]
    at_rest: RestAnalysis | None
    dropped: tuple[str, ...]
    left: Leftover | None
    forms_tried: int
    checks: tuple[Check, ...]

    def evidence_of(self, finding: Finding) -> tuple[Points, TwistModel, tuple[Form, ...]]:
        """The points and the equation that determine a finding's figures, and its forms there."""
        if finding.at_rest is None:
            return self.held.points, self.after.model, finding.forms
        return finding.at_rest.points, finding.at_rest.after.model, finding.at_rest.after.model.forms

    @property
    def steps(self) -> list[tuple[str | None, TwistTrial]]:
        """The straight line, then the model after each round."""
        found = [(this.winner.name, this.winner.trial) for this in self.rounds if this.accepted]
        rested = () if self.at_rest is None else self.at_rest.terms
        return [(None, self.before), *found, *((form.name, self.after) for form, _ in rested)]


def catalogue(points: Points) -> tuple[Form, ...]:
    """The forms that the logs may determine, the more common ones first.

    A loop may have either sign: with torque from a motor's current, friction on the motor's side reverses it.
    """
    return (*torque_forms(points), *motion_forms(points))


def close_loop(
    points: Points, *, max_effects: int = 3, seed: int = 0, progress: Callable[[str], None] = lambda message: None
) -> QuasiStaticLoop:
    """Close the loop between the torque-twist equation and quasi-static logs of one drive.

    Args:
        points: Of the logs.
        max_effects: Most families of effects.
        seed: Of the surrogates for p-values.
        progress: Receives messages.
    """
    held, forms = Held.of(points), catalogue(points)
    base = current = held.attempt()
    rounds: list[TwistRound] = []
    while still_open := _still_open(forms, current, max_effects):
        progress("screening the catalogue")
        rounds.append(look(held, current, base, still_open, seed + len(rounds)))
        if not rounds[-1].accepted:
            break
        current = rounds[-1].winner.trial
        progress(f"found {rounds[-1].winner.name}")
    current, dropped = _without_superfluous(held, current, base)
    current, untold = _without_undetermined(held, current, rounds)
    dropped += untold
    at_rest = None
    families = {form.family for form in current.model.forms}
    if "creep" not in families and len(families) < max_effects:
        progress("analysing the rests")
        at_rest = analyse_rests(held, current, seed)
        if at_rest is not None and at_rest.terms:
            current = held.beside(current, at_rest.terms)
            progress(f"found {at_rest.terms[0][0].name}")
    left = leftover(held, current, base, seed)
    decision, final_checks = _decide(points, base, current, left)
    looks = rounds if at_rest is None else (*rounds, at_rest.round)
    asked = (check for this in looks for seen in this.evidence.asked for check in support(seen))
    return QuasiStaticLoop(
        decision=decision,
        held=held,
        before=base,
        after=current,
        findings=_findings(held, current, rounds, at_rest),
        rounds=tuple(rounds),
        at_rest=at_rest,
        dropped=dropped,
        left=left,
        forms_tried=len(forms) if rounds else 0,
        checks=(*(check for check in asked if math.isfinite(check.statistic)), *final_checks),
    )


def _still_open(forms: tuple[Form, ...], current: TwistTrial, max_effects: int) -> list[tuple[Form, ...]]:
    """Forms that may be added: new families up to the limit, and further forms of accepted ones."""
    present = [form.family for form in current.model.forms]
    included = {form.includes for form in current.model.forms}
    free = max_effects - len(set(present))
    left = [
        form
        for form in forms
        if form not in current.model.forms
        and form.name not in included
        and (form.family in present or free > 0)
        and present.count(form.family) < _MOST_OF_A_FAMILY
    ]
    alone = [(form,) for form in left]
    if present or free < 2:
        return alone
    # Also pairs of a bend and a loop, since each masks the other.
    loops = [form for form in left if form.family == "hysteresis"]
    bends = [form for form in left if form.family == "stiffness_shape" and not form.shape_names]
    return alone + [(loop, bend) for loop in loops for bend in bends]


def _without_superfluous(held: Held, trial: TwistTrial, base: TwistTrial) -> tuple[TwistTrial, tuple[str, ...]]:
    """The model without superfluous forms."""
    dropped = []
    for form in trial.model.forms if len(trial.model.forms) > 1 else ():
        poorer = held.without(trial, [form])
        least = RULES.quasi_static_imperfection**2 * (base.mean_square - trial.mean_square)
        if trial.gain_over(poorer) < RULES.least_gain or poorer.mean_square - trial.mean_square < least:
            trial = poorer
            dropped.append(form.name)
    return trial, tuple(dropped)


def _without_undetermined(
    held: Held, trial: TwistTrial, rounds: Sequence[TwistRound]
) -> tuple[TwistTrial, tuple[str, ...]]:
    """The model without undetermined forms, nor those that were significant only together with one."""
    dropped: list[str] = []
    while untold := [form for form in trial.model.forms if not is_determined(held.points, trial.model, form)]:
        pairs = (r.winner.trial.beyond(r.before) for r in rounds if r.accepted)
        pair = next(pair for pair in pairs if untold[-1] in pair)
        gone = [form for form in trial.model.forms if form in pair]
        trial = held.without(trial, gone)
        dropped += [form.name for form in gone]
    return trial, tuple(dropped)


def _findings(
    held: Held, after: TwistTrial, rounds: list[TwistRound], at_rest: RestAnalysis | None
) -> tuple[Finding, ...]:
    chances = [(form, r.winner.p_value) for r in rounds if r.accepted for form in r.winner.trial.beyond(r.before)]
    found = []
    for family in dict.fromkeys(form.family for form in after.model.forms):
        own = tuple(form for form in after.model.forms if form.family == family)
        gain = 1.0 - after.rmse / held.without(after, own).rmse
        if at_rest is not None and own[0] in dict(at_rest.terms):
            found.append(Finding(family, own, gain, at_rest.p_value, at_rest))
        else:
            found.append(Finding(family, own, gain, min(chance for form, chance in chances if form in own)))
    return tuple(sorted(found, key=lambda one: -one.validation_gain))


def _decide(
    points: Points, base: TwistTrial, after: TwistTrial, left: Leftover | None
) -> tuple[Outcome, tuple[Check, ...]]:
    """Decide; a residual is unexplained if it depends on a logged quantity, or is too large for the torque's error and
    coloured noise."""
    names, noise = tuple(form.name for form in after.model.forms), points.twist_noise
    most = (RULES.wander * noise) ** 2 + torque_error(points, base)
    explained = left is None and (bool(names) or base.mean_square <= most)
    seen = FinalEvidence(names, False, (after.rmse / noise,), (base.rmse / noise,), noise_explains=explained)
    return conclude(seen, replace(RULES, explained=RULES.quasi_static_explained))
