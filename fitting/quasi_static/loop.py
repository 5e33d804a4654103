"""The whole story for quasi-static logs: fit the line, look at what it leaves over, add the effect behind it, refit."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from fitting.attribution.decisions import RULES
from fitting.quasi_static.attribution import Held, Round, Trial, look
from fitting.quasi_static.candidates import catalogue, choices
from fitting.quasi_static.form import Form
from fitting.quasi_static.leftover import Leftover, leftover
from fitting.quasi_static.points import Points
from fitting.quasi_static.rests import RestLook, look_at_rests
from fitting.quasi_static.stretches import stretches
from fitting.quasi_static.twist_model import TwistModel, fit_twist

Decision = Literal["effect_found", "model_sufficient", "unexplained"]

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
    """

    decision: Decision
    held: Held
    before: Trial
    after: Trial
    findings: tuple[Finding, ...]
    rounds: tuple[Round, ...]
    at_rest: RestLook | None
    dropped: tuple[str, ...]
    left: Leftover | None
    forms_tried: int

    def told_by(self, finding: Finding) -> tuple[Points, TwistModel, tuple[Form, ...]]:
        """The points and the equation that tell a finding's figures, and its forms there."""
        if finding.at_rest is None:
            return self.held.points, self.after.model, finding.forms
        return finding.at_rest.held.points, finding.at_rest.after.model, finding.at_rest.after.model.forms


def _silent(message: str) -> None:
    pass


def close_loop(
    points: Points, *, max_effects: int = 3, seed: int = 0, progress: Callable[[str], None] = _silent
) -> QuasiStaticLoop:
    """Close the loop between the torque-twist equation and quasi-static logs of one drive.

    Args:
        points: Of the logs.
        max_effects: Families of effects to add at most.
        seed: Of the surrogates behind the p-values.
        progress: Told what is being done.
    """
    line = fit_twist(points, (), ())
    # Two stretches in each log at least, so that its zero is known where one is held out.
    held = Held.of(points, stretches(line.misfit, points.log, each=2))
    base = held.attempt((), ())
    forms = catalogue(points)
    current, rounds = base, []
    while still_open := _still_open(forms, current, max_effects):
        progress("looking through the catalogue")
        this = look(held, current, base, still_open, seed + len(rounds), RULES.quasi_static_imperfection)
        rounds.append(this)
        if not this.accepted:
            break
        current = this.rivals[0].trial
        progress(f"found {this.rivals[0].lead.name}")
    current, dropped = _without_superfluous(held, current, base)
    at_rest = None
    families = {form.family for form in current.model.forms}
    if "creep" not in families and len(families) < max_effects:
        progress("looking at the rests")
        at_rest = look_at_rests(held, current, seed)
        if at_rest is not None and at_rest.form is not None:
            current = held.attempt((*current.model.forms, at_rest.form), (*current.model.shapes, at_rest.shape))
            progress(f"found {at_rest.form.name}")
    left = leftover(held, current, base, seed)
    return QuasiStaticLoop(
        decision=_decide(base, current, left, points.twist_noise),
        held=held,
        before=base,
        after=current,
        findings=_findings(held, current, rounds, at_rest),
        rounds=tuple(rounds),
        at_rest=at_rest,
        dropped=dropped,
        left=left,
        forms_tried=len(forms),
    )


def _still_open(forms: tuple[Form, ...], current: Trial, max_effects: int) -> list[tuple[Form, ...]]:
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
    return choices(left, 0 if present else free)


def _without_superfluous(held: Held, trial: Trial, base: Trial) -> tuple[Trial, tuple[str, ...]]:
    """The model without forms that hardly matter beside the others."""
    dropped = []
    for form in trial.model.forms if len(trial.model.forms) > 1 else ():
        poorer = held.without(trial, [form])
        least = RULES.quasi_static_imperfection**2 * (base.mean_square - trial.mean_square)
        if trial.gain_over(poorer) < RULES.least_gain or poorer.mean_square - trial.mean_square < least:
            trial = poorer
            dropped.append(form.name)
    return trial, tuple(dropped)


def _findings(held: Held, after: Trial, rounds: list[Round], at_rest: RestLook | None) -> tuple[Finding, ...]:
    found = []
    for family in dict.fromkeys(form.family for form in after.model.forms):
        own = tuple(form for form in after.model.forms if form.family == family)
        gain = 1.0 - after.rmse / held.without(after, own).rmse
        if at_rest is not None and at_rest.form in own:
            found.append(Finding(family, own, gain, at_rest.p_value, at_rest))
        else:
            chance = min(r.rivals[0].p_value for r in rounds if r.accepted and set(r.rivals[0].lead.forms) & set(own))
            found.append(Finding(family, own, gain, chance))
    return tuple(sorted(found, key=lambda one: -one.validation_gain))


def _decide(base: Trial, after: Trial, left: Leftover | None, noise: float) -> Decision:
    """Something unexplained is what predictably depends on something, or what is too large for noise of any colour."""
    if after is base and left is None:
        return "unexplained" if base.rmse > RULES.wander * noise else "model_sufficient"
    if left is None or after.rmse < RULES.excess * noise:
        return "effect_found" if after is not base else "model_sufficient"
    before, behind = (max(t.mean_square - noise**2, 0.0) for t in (base, after))
    explained = 1.0 - behind / before if before > 0 else 0.0
    return "effect_found" if after is not base and explained >= RULES.quasi_static_explained else "unexplained"
