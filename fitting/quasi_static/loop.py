"""The whole story for quasi-static logs: fit the line, look at what it leaves over, add the effect behind it, refit."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from fitting.attribution.case_evidence import FinalEvidence
from fitting.attribution.decisions import Check, Outcome, conclude, support
from fitting.attribution.rules import RULES
from fitting.quasi_static.attribution import Held, TwistRound, TwistTrial, is_told, look
from fitting.quasi_static.form import Form
from fitting.quasi_static.leftover import Leftover, leftover
from fitting.quasi_static.motion_forms import motion_forms
from fitting.quasi_static.points import Points
from fitting.quasi_static.rests import RestLook, look_at_rests
from fitting.quasi_static.torque_forms import torque_forms
from fitting.quasi_static.twist_model import TwistModel, stiffness_of

# Forms of one family in a model: orders of an angle, sliders side by side.
_MOST_OF_A_FAMILY = 4


@dataclass(frozen=True, eq=False)
class Finding:
    """A family of effects that the logs support.

    Attributes:
        family: Its name.
        forms: Its forms in the final model, in the order in which they were found.
        validation_gain: Share of the held-out error that it removes, against the final model without it.
        p_value: Chance that the best of the catalogue would gain as much on noise.
        at_rest: Where it was found among the points at rest, which then tell its figures; else None.
    """

    family: str
    forms: tuple[Form, ...]
    validation_gain: float
    p_value: float
    at_rest: RestLook | None = None


@dataclass(frozen=True, eq=False)
class QuasiStaticLoop:
    """The outcome of closing the loop on quasi-static logs.

    Attributes:
        decision: What the logs say.
        held: The points, and how they were parted.
        before: The straight line.
        after: The final model; the same where nothing was found.
        findings: Largest gain first.
        rounds: Every look at the catalogue.
        at_rest: The look at rests, or None where no joint rested.
        dropped: Forms that a later one made superfluous.
        left: What the final model leaves over, where it depends on something.
        forms_tried: Number of forms in the catalogue.
        checks: Every rule as it was applied.
    """

    decision: Outcome
    held: Held
    before: TwistTrial
    after: TwistTrial
    findings: tuple[Finding, ...]
    rounds: tuple[TwistRound, ...]
    at_rest: RestLook | None
    dropped: tuple[str, ...]
    left: Leftover | None
    forms_tried: int
    checks: tuple[Check, ...]

    def told_by(self, finding: Finding) -> tuple[Points, TwistModel, tuple[Form, ...]]:
        """The points and the equation that tell a finding's figures, and its forms there."""
        if finding.at_rest is None:
            return self.held.points, self.after.model, finding.forms
        return finding.at_rest.points, finding.at_rest.after.model, finding.at_rest.after.model.forms

    @property
    def steps(self) -> list[tuple[str | None, TwistTrial]]:
        """The straight line, then what each round has added to it."""
        found = [(this.winner.name, this.winner.trial) for this in self.rounds if this.accepted]
        rested = () if self.at_rest is None else self.at_rest.terms
        return [(None, self.before), *found, *((form.name, self.after) for form, _ in rested)]


def catalogue(points: Points) -> tuple[Form, ...]:
    """The forms that the logs can tell something about, the more usual ones first.

    A loop may run either way: friction on the motor's side turns it round, where the torque is a motor's current.
    """
    return (*torque_forms(points), *motion_forms(points))


def close_loop(
    points: Points, *, max_effects: int = 3, seed: int = 0, progress: Callable[[str], None] = lambda message: None
) -> QuasiStaticLoop:
    """Close the loop between the torque-twist equation and quasi-static logs of one drive.

    Args:
        points: Of the logs.
        max_effects: Families of effects to add at most.
        seed: Of the surrogates behind the p-values.
        progress: Told what is being done.
    """
    held, forms = Held.of(points), catalogue(points)
    base = current = held.attempt()
    rounds: list[TwistRound] = []
    while still_open := _still_open(forms, current, max_effects):
        progress("looking through the catalogue")
        rounds.append(look(held, current, base, still_open, seed + len(rounds)))
        if not rounds[-1].accepted:
            break
        current = rounds[-1].winner.trial
        progress(f"found {rounds[-1].winner.name}")
    current, dropped = _without_superfluous(held, current, base)
    current, untold = _without_untold(held, current)
    dropped += untold
    at_rest = None
    families = {form.family for form in current.model.forms}
    if "creep" not in families and len(families) < max_effects:
        progress("looking at the rests")
        at_rest = look_at_rests(held, current, seed)
        if at_rest is not None and at_rest.terms:
            current = held.beside(current, at_rest.terms)
            progress(f"found {at_rest.terms[0][0].name}")
    left = leftover(held, current, base, seed)
    decision, final_checks = _decide(base, current, left, points.twist_noise)
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
        forms_tried=len(forms),
        checks=(*(check for check in asked if math.isfinite(check.statistic)), *final_checks),
    )


def _still_open(forms: tuple[Form, ...], current: TwistTrial, max_effects: int) -> list[tuple[Form, ...]]:
    """What may be added: new families up to the most that are wanted, and further forms of those found."""
    present = [form.family for form in current.model.forms]
    free = max_effects - len(set(present))
    left = [
        form
        for form in forms
        if form not in current.model.forms
        and (form.family in present or free > 0)
        and present.count(form.family) < _MOST_OF_A_FAMILY
    ]
    alone = [(form,) for form in left]
    if present or free < 2:
        return alone
    # Each bend together with each loop as well, of which either hides the other.
    loops = [form for form in left if form.family == "hysteresis"]
    bends = [form for form in left if form.family == "stiffness_shape" and not form.shape_names]
    return alone + [(loop, bend) for loop in loops for bend in bends]


def _without_superfluous(held: Held, trial: TwistTrial, base: TwistTrial) -> tuple[TwistTrial, tuple[str, ...]]:
    """The model without forms that hardly matter beside the others."""
    dropped = []
    for form in trial.model.forms if len(trial.model.forms) > 1 else ():
        poorer = held.without(trial, [form])
        least = RULES.quasi_static_imperfection**2 * (base.mean_square - trial.mean_square)
        if trial.gain_over(poorer) < RULES.least_gain or poorer.mean_square - trial.mean_square < least:
            trial = poorer
            dropped.append(form.name)
    return trial, tuple(dropped)


def _without_untold(held: Held, trial: TwistTrial) -> tuple[TwistTrial, tuple[str, ...]]:
    """The model without forms of which the logs tell no figure, where they do not tell the stiffness beside them
    either: such forms only take each other's place."""
    dropped = []
    while not stiffness_of(held.points, trial.model)["K"].identifiable:
        untold = [form for form in trial.model.forms if not is_told(held.points, trial.model, form)]
        if not untold:
            break
        trial = held.without(trial, untold[-1:])
        dropped.append(untold[-1].name)
    return trial, tuple(dropped)


def _findings(held: Held, after: TwistTrial, rounds: list[TwistRound], at_rest: RestLook | None) -> tuple[Finding, ...]:
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
    base: TwistTrial, after: TwistTrial, left: Leftover | None, noise: float
) -> tuple[Outcome, tuple[Check, ...]]:
    """Something unexplained is what predictably depends on something, or what is too large for noise of any colour."""
    names = tuple(form.name for form in after.model.forms)
    explained = left is None and (bool(names) or base.rmse <= RULES.wander * noise)
    seen = FinalEvidence(names, False, (after.rmse / noise,), (base.rmse / noise,), noise_explains=explained)
    return conclude(seen, replace(RULES, explained=RULES.quasi_static_explained))
