"""Decisions of the loop: the rules applied to the evidence.

Pure functions without fits or simulations: stored evidence can be decided again under other rules.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from fitting.attribution.case_evidence import (
    CaseEvidence,
    ChallengeEvidence,
    EffectEvidence,
    FinalEvidence,
    NoiseEvidence,
    Question,
    Rival,
)
from fitting.attribution.rules import RULES, DecisionRules

Outcome = Literal["effect_found", "model_sufficient", "unexplained"]


@dataclass(frozen=True)
class Check:
    """Result of applying a rule.

    Attributes:
        rule: its name in [`DecisionRules`][].
        about: what was tested.
        statistic: value from the data.
        threshold: value that it is compared with.
        holds: whether the rule is met.
    """

    rule: str
    about: str
    statistic: float
    threshold: float
    holds: bool


def support(seen: EffectEvidence, rules: DecisionRules = RULES) -> tuple[Check, ...]:
    """Whether the data support an effect: all checks must hold.

    Args:
        seen: the evidence for it.
        rules: the thresholds.
    """
    errors, chance = rules.strength_errors, rules.significance
    nats, over = rules.noise_gain, seen.over_noise
    # Selection data may hardly excite the effect (the end of a chirp). Against a noise model training data count.
    least = rules.least_gain if np.isinf(over) else 0.0
    return (
        Check("least_gain", seen.name, seen.gain, least, seen.gain > least),
        Check("significance", seen.name, seen.p_value, chance, seen.p_value <= chance),
        Check("imperfection", seen.name, seen.removed, seen.imperfection, seen.removed > seen.imperfection),
        Check("strength_errors", seen.name, seen.strength_errors, errors, seen.strength_errors > errors),
        Check("noise_gain", seen.name, over, nats, over > nats),
        Check("at_bounds", seen.name, float(seen.at_bounds), rules.at_bounds, seen.at_bounds <= rules.at_bounds),
    )


def tie(name: str, behind: Float[np.ndarray, " blocks"], lost: float = np.inf, rules: DecisionRules = RULES) -> Check:
    """Whether a candidate is tied with the chosen one: one-sided test of paired differences over blocks. A difference
    below the least gain is none.

    Args:
        name: of the candidate.
        behind: log predictive density of the chosen one minus that of the candidate, block by block.
        lost: gain of the chosen one minus that of the candidate.
        rules: the thresholds.
    """
    if lost < rules.least_gain:
        return Check("least_gain", name, lost, rules.least_gain, True)
    count = behind.size
    if count < 2:
        return Check("tie_level", name, 0.0, np.inf, True)
    error = float(np.std(behind, ddof=1) / np.sqrt(count))
    mean, limit = float(np.mean(behind)), float(stdtrit(count - 1, 1.0 - rules.tie_level))
    statistic = mean / error if error > 0 else (np.inf if mean > 0 else 0.0)
    return Check("tie_level", name, statistic, limit, statistic <= limit)


def compete(best: Rival, others: Sequence[Rival]) -> tuple[Rival, ...]:
    """The candidates that compete over whole stretches: the best one and its ties; all where the best one has memory,
    whose states are free on short segments.

    Args:
        best: the candidate with the largest gain over short segments.
        others: the others.
    """
    return best, *(r for r in others if r.gain > RULES.least_gain and (r.tied or best.remembers))


def leader(rivals: Sequence[Rival], rules: DecisionRules = RULES) -> tuple[Rival, tuple[str, ...]]:
    """The chosen candidate: of those with equal gain the simplest, plausible ones first.

    Gains are compared over whole stretches; where these are equal, over short segments, in which less accumulates.

    Args:
        rivals: the competing candidates.
        rules: the thresholds.

    Returns:
        The candidate, and the names of those with equal gain.
    """

    def least(most: float) -> float:
        return most - max(rules.least_gain, rules.same_gain * abs(most))

    close = [r for r in rivals if r.long_gain >= least(max(r.long_gain for r in rivals))]
    least_gain = least(max(r.gain for r in close))
    close = [r for r in close if r.tied or r.gain >= least_gain]
    first = min(close, key=lambda r: (not r.plausible, r.parameters, r.states, -r.gain))
    return first, tuple(r.name for r in close)


def only_noise(seen: NoiseEvidence, rules: DecisionRules = RULES) -> tuple[Check, ...]:
    """Whether noise of sensors and torque explains a residual: all checks must hold.

    Args:
        seen: the innovations of the filter.
        rules: the thresholds.
    """
    about = f"noise of the sensors, and of the torque by {100 * seen.share:.2g} % of its rms"
    return (
        Check("innovations", about, seen.predictable, rules.innovations, seen.predictable <= rules.innovations),
        Check("excess", "innovations of that filter", seen.size, rules.excess, seen.size < rules.excess),
    )


def next_question(seen: ChallengeEvidence, rules: DecisionRules = RULES) -> Question | None:
    """The learned term needed next to accept or reject named effects; None where none is.

    Args:
        seen: the evidence so far.
        rules: the thresholds.
    """
    if seen.enough and (seen.names or "beside" in seen.asked):
        return None
    little = _leaves_little(seen, rules)
    if seen.names and not little and "instead" not in seen.asked:
        return "instead"
    if seen.instead is not None and seen.instead.white and seen.come_out < rules.come_out:
        # No further term could improve the named model.
        return None
    if "beside" not in seen.asked:
        return "beside"
    if not seen.names or "instead" in seen.asked:
        return None
    settled = _adds_little(seen, rules) if seen.beside is not None else little
    return None if settled else "instead"


def names_stand(seen: ChallengeEvidence, rules: DecisionRules = RULES) -> tuple[Check, ...]:
    """Whether named effects are accepted: one check that holds is enough.

    Named effects are rejected where a learned term in their place predicts selection data as well as one beside them,
    or better than they do with fewer parameters. It must also differ from the named effects, or predict far better with
    fewer parameters. A term beside which a name is not significant counts as different. Free runs with the term in
    place of the names must be at most `lasting` worse.

    Args:
        seen: the evidence.
        rules: the thresholds.
    """
    if seen.instead is None:
        return (Check("come_out", "no learned term contradicts the names", 1.0, rules.come_out, True),)
    beside, instead = seen.beside, seen.instead
    rival = seen.named if beside is None else beside
    better_by = rival.selection - instead.selection
    gain = seen.base.selection - instead.selection
    fewer = rival.parameters - instead.parameters
    by_far = better_by > rules.little * gain
    as_good = by_far or (beside is not None and better_by >= -rules.least_gain)
    come_out = seen.come_out >= rules.come_out and seen.shown
    simpler = (by_far and fewer > 0) or (seen.one_shape and fewer >= 0)
    if beside is not None and _adds_little(seen, rules):
        # Without the term beside them the names alone are compared.
        better_by = seen.named.selection - instead.selection
        as_good = better_by > rules.least_gain and seen.named.parameters > instead.parameters
        if not as_good:
            added = seen.named.selection - beside.selection
            return (Check("little", "gain of a learned term beside the names", added, rules.little, True),)
    return (
        Check("little", "a learned term in their place predicts as well", better_by, -rules.least_gain, not as_good),
        Check(
            "come_out",
            "share of a learned term in their place that the names reproduce",
            seen.come_out,
            rules.come_out,
            come_out and not simpler,
        ),
        Check(
            "lasting",
            "free runs with the learned term in their place",
            seen.longer_worse,
            rules.lasting,
            seen.longer_worse > rules.lasting,
        ),
    )


def unknown_ties(seen: ChallengeEvidence, rules: DecisionRules = RULES) -> tuple[Check, ...]:
    """Whether a learned term that differs from the accepted names is tied with them: the check holds then.

    Args:
        seen: the evidence.
        rules: the thresholds.
    """
    if seen.instead is None or not seen.behind or seen.come_out >= rules.come_out:
        return ()
    lost = seen.instead.selection - seen.named.selection
    return (tie("a learned term in place of the names", np.array(seen.behind), lost, rules),)


def _leaves_little(seen: ChallengeEvidence, rules: DecisionRules) -> bool:
    """Whether a term that left only noise would gain little over the names."""
    return seen.named.selection - seen.noise < rules.little * (seen.base.selection - seen.noise)


def _adds_little(seen: ChallengeEvidence, rules: DecisionRules) -> bool:
    """Whether a term beside the names gains little, on training and on selection data; motions of the two may
    differ."""
    if seen.beside is None:
        return False
    pairs = [
        (seen.named.training - seen.beside.training, seen.base.training - seen.named.training),
        (seen.named.selection - seen.beside.selection, seen.base.selection - seen.named.selection),
    ]
    return all(added < rules.little * explained for added, explained in pairs)


def conclude(seen: FinalEvidence, rules: DecisionRules = RULES) -> tuple[Outcome, tuple[Check, ...]]:
    """The conclusion, and the checks that led to it.

    Args:
        seen: the evidence.
        rules: the thresholds.
    """
    left, first = np.array(seen.excess), np.array(seen.excess_at_first)
    if not seen.names:
        most = float(np.max(left))
        check = Check("excess", "residual over the noise", most, rules.excess, most < rules.excess)
        enough = not seen.learned and (check.holds or seen.noise_explains)
        return "model_sufficient" if enough else "unexplained", (check,)
    output = int(np.argmax(first))
    share = float(1.0 - (left[output] ** 2 - 1.0) / max(first[output] ** 2 - 1.0, 1e-12))
    about = "residual with the named effects over the noise"
    checks = [
        Check("excess", about, float(left[output]), rules.excess, bool(left[output] < rules.excess)),
        Check("explained", "variance that they remove", share, rules.explained, share >= rules.explained),
    ]
    found = any(check.holds for check in checks) or (seen.noise_explains and not seen.learned)
    most = rules.at_bounds
    checks.append(Check("at_bounds", "final fit", float(seen.at_bounds), most, seen.at_bounds <= most))
    found = found and checks[-1].holds
    if found and seen.surprise is not None and seen.free_runs_explained is not None:
        ratio, most = seen.surprise, rules.surprise
        checks.append(Check("surprise", "error of free runs over their bands", ratio, most, ratio <= most))
        found = checks[-1].holds
        if not seen.noise_explains:
            # Laws are not exact, which bands do not include. But what noise is said to explain must be within them.
            share, least = seen.free_runs_explained, rules.free_run_explained
            checks.append(Check("free_run_explained", "of free runs, likewise", share, least, share >= least))
            found = found or checks[-1].holds
    return "effect_found" if found else "unexplained", tuple(checks)


@dataclass(frozen=True)
class Decision:
    """A conclusion under given rules.

    Attributes:
        outcome: the conclusion.
        names: of the accepted effects.
        checks: every applied rule.
        lacking: evidence that these rules need but that was not gathered; None where it is complete.
    """

    outcome: Outcome
    names: tuple[str, ...]
    checks: tuple[Check, ...]
    lacking: str | None = None


def decide(evidence: CaseEvidence, rules: DecisionRules = RULES) -> Decision:
    """Decide a case.

    Args:
        evidence: of the case.
        rules: the thresholds; if they differ from those of the loop, evidence may be missing.
    """
    checks: list[Check] = []
    lacking: list[str] = []
    for number, this in enumerate(evidence.rounds, start=1):
        lost = {name: this.lost.get(name, np.inf) for name in this.behind}
        # Without the chosen one against itself.
        others = {name: np.array(blocks) for name, blocks in this.behind.items() if any(blocks)}
        checks += [tie(name, blocks, lost[name], rules) for name, blocks in others.items()]
        supported = [support(seen, rules) for seen in this.asked]
        checks += [check for those in supported for check in those]
        last = number == len(evidence.rounds)
        first = next((i for i, those in enumerate(supported) if all(c.holds for c in those)), None)
        accepted = all(c.holds for c in support(this.asked[-1])) if this.asked else False
        if (first is not None) != accepted or (first is not None and first != len(supported) - 1):
            lacking.append(f"round {number}: another candidate would be accepted")
        elif this.rivals and not last and leader(this.rivals, rules)[0].name not in [seen.name for seen in this.asked]:
            lacking.append(f"round {number}: another candidate would lead")
    noise = () if evidence.challenge.left is None else only_noise(evidence.challenge.left, rules)
    checks += noise
    explains = bool(noise) and evidence.challenge.beside is None and all(check.holds for check in noise)
    question = next_question(evidence.challenge, rules)
    if question is not None:
        lacking.append(f"a learned term {question}")
    names = evidence.final.names
    if evidence.challenge.names:
        stand = names_stand(evidence.challenge, rules)
        checks += (*stand, *unknown_ties(evidence.challenge, rules))
        if any(check.holds for check in stand) != bool(names):
            lacking.append("the final model with other names")
    outcome, last_checks = conclude(replace(evidence.final, noise_explains=explains), rules)
    if evidence.final.replaced and outcome == "unexplained":
        names = ()
    return Decision(outcome, names, (*checks, *last_checks), lacking[0] if lacking else None)
