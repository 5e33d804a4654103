"""Every decision of the loop: what the rules make of the evidence.

Nothing here fits, simulates or reads: the same evidence and the same rules give the same decision, so that stored
evidence can be decided anew under other rules.
"""

from collections.abc import Sequence
from dataclasses import dataclass
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
    """A rule as it was applied.

    Attributes:
        rule: its name in [`DecisionRules`][].
        about: what it was asked of.
        statistic: what the data say.
        threshold: what the rule compares it with.
        holds: whether it is met.
    """

    rule: str
    about: str
    statistic: float
    threshold: float
    holds: bool


def support(seen: EffectEvidence, rules: DecisionRules = RULES) -> tuple[Check, ...]:
    """Whether the data support an effect: all checks must hold.

    Args:
        seen: what they say.
        rules: the thresholds.
    """
    least, errors, chance = rules.least_gain, rules.strength_errors, rules.significance
    nats, over = rules.noise_gain, seen.over_noise
    return (
        Check("least_gain", seen.name, seen.gain, least, seen.gain > least),
        Check("significance", seen.name, seen.p_value, chance, seen.p_value <= chance),
        Check("imperfection", seen.name, seen.removed, seen.imperfection, seen.removed > seen.imperfection),
        Check("strength_errors", seen.name, seen.strength_errors, errors, seen.strength_errors > errors),
        Check("noise_gain", seen.name, over, nats, over > nats),
        Check("at_bounds", seen.name, float(seen.at_bounds), rules.at_bounds, seen.at_bounds <= rules.at_bounds),
    )


def tie(name: str, behind: Float[np.ndarray, " blocks"], rules: DecisionRules = RULES) -> Check:
    """Whether a candidate can't be told from the best one: paired differences over blocks, one-sided.

    Args:
        name: of the candidate.
        behind: log predictive density of the best one less that of the candidate, block by block.
        rules: the thresholds.
    """
    count = behind.size
    if count < 2:
        return Check("tie_level", name, 0.0, np.inf, True)
    error = float(np.std(behind, ddof=1) / np.sqrt(count))
    mean, limit = float(np.mean(behind)), float(stdtrit(count - 1, 1.0 - rules.tie_level))
    statistic = mean / error if error > 0 else (np.inf if mean > 0 else 0.0)
    return Check("tie_level", name, statistic, limit, statistic <= limit)


def compete(best: Rival, others: Sequence[Rival], rules: DecisionRules = RULES) -> tuple[Rival, ...]:
    """Those that compete over whole stretches, the best one included: what is tied with it, and all where it has a
    memory, whose states short segments leave free.

    Args:
        best: the candidate with the largest gain over short segments.
        others: the others.
        rules: the thresholds.
    """
    return best, *(r for r in others if r.gain > rules.least_gain and (r.tied or best.remembers))


def leader(rivals: Sequence[Rival], rules: DecisionRules = RULES) -> tuple[Rival, tuple[str, ...]]:
    """Which candidate is taken: of those that gain as much over whole stretches the simplest, a plausible one first.

    Args:
        rivals: those that compete.
        rules: the thresholds.

    Returns:
        The candidate, and the names of those that gain as much.
    """
    most = max(r.long_gain for r in rivals)
    least = most - max(rules.least_gain, rules.same_gain * abs(most))
    close = [r for r in rivals if r.long_gain >= least]
    first = min(close, key=lambda r: (not r.plausible, r.parameters, r.states, -r.gain))
    return first, tuple(r.name for r in close)


def only_noise(seen: NoiseEvidence, rules: DecisionRules = RULES) -> tuple[Check, ...]:
    """Whether what a model leaves is noise of sensors and torque: all checks must hold.

    Args:
        seen: what the filter leaves.
        rules: the thresholds.
    """
    about = f"noise of the sensors, and of the torque by {100 * seen.share:.2g} % of its rms"
    return (
        Check("innovations", about, seen.predictable, rules.innovations, seen.predictable <= rules.innovations),
        Check("excess", "innovations of that filter", seen.size, rules.excess, seen.size < rules.excess),
    )


def next_question(seen: ChallengeEvidence, rules: DecisionRules = RULES) -> Question | None:
    """What must be learned next before names can be trusted; None where enough is known.

    Args:
        seen: what is known.
        rules: the thresholds.
    """
    enough = seen.enough
    if enough and seen.names < rules.many:
        return None
    little = _leaves_little(seen, rules)
    if seen.names and not enough and not little and "instead" not in seen.asked:
        return "instead"
    if seen.instead is not None and seen.instead.white and seen.come_out < rules.come_out:
        # Nothing beside the names could be better.
        return None
    if not enough and "beside" not in seen.asked:
        return "beside"
    if not seen.names or "instead" in seen.asked:
        return None
    settled = _adds_little(seen, rules) if seen.beside is not None else little and not enough
    return None if settled else "instead"


def names_stand(seen: ChallengeEvidence, rules: DecisionRules = RULES) -> tuple[Check, ...]:
    """Whether names can be trusted: one check that holds is enough.

    A learned term in the place of a name is free to be anything. The name is doubtful where that term predicts
    selection data as well as one beside the name. It must also differ from the named effect, or do better by far with
    fewer parameters.

    Args:
        seen: all that was asked.
        rules: the thresholds.
    """
    if seen.instead is None:
        return (Check("come_out", "no learned term contradicts the names", 1.0, rules.come_out, True),)
    beside, instead = seen.beside, seen.instead
    enough = seen.enough
    rival = seen.named if beside is None else beside
    better_by = rival.selection - instead.selection
    gain = seen.base.selection - instead.selection
    fewer = rival.parameters - instead.parameters
    by_far = better_by > rules.little * gain
    as_good = by_far or ((beside is not None or (enough and fewer > 0)) and better_by >= -rules.least_gain)
    come_out = seen.come_out >= rules.come_out and seen.shown
    simpler = (by_far and fewer > 0) or (seen.one_shape and fewer >= 0)
    if beside is not None and _adds_little(seen, rules):
        added = seen.named.selection - beside.selection
        return (Check("little", "what a learned term adds to the names", added, rules.little, True),)
    return (
        Check("little", "a learned term in their place predicts as well", better_by, -rules.least_gain, not as_good),
        Check(
            "come_out",
            "a learned term in their place comes out as the names",
            seen.come_out,
            rules.come_out,
            come_out and not simpler,
        ),
        Check(
            "lasting",
            "free runs with the learned term, against the names",
            seen.longer_worse,
            rules.lasting,
            seen.longer_worse > rules.lasting,
        ),
    )


def _leaves_little(seen: ChallengeEvidence, rules: DecisionRules) -> bool:
    """Whether not even a term that left nothing but noise would be better than the names by far."""
    return seen.named.selection - seen.noise < rules.little * (seen.base.selection - seen.noise)


def _adds_little(seen: ChallengeEvidence, rules: DecisionRules) -> bool:
    """Whether a term beside the names adds next to nothing, on training and on selection data: either may show motions
    that the other does not."""
    if seen.beside is None:
        return False
    pairs = [
        (seen.named.training - seen.beside.training, seen.base.training - seen.named.training),
        (seen.named.selection - seen.beside.selection, seen.base.selection - seen.named.selection),
    ]
    return all(added < rules.little * explained for added, explained in pairs)


def conclude(seen: FinalEvidence, rules: DecisionRules = RULES) -> tuple[Outcome, tuple[Check, ...]]:
    """What the data say in the end, and the checks that led there.

    Args:
        seen: the evidence.
        rules: the thresholds.
    """
    left, first = np.array(seen.excess), np.array(seen.excess_at_first)
    if not seen.names:
        most = float(np.max(left))
        check = Check("excess", "what the model leaves over", most, rules.excess, most < rules.excess)
        enough = not seen.learned and (check.holds or seen.noise_explains)
        return "model_sufficient" if enough else "unexplained", (check,)
    output = int(np.argmax(first))
    share = float(1.0 - (left[output] ** 2 - 1.0) / max(first[output] ** 2 - 1.0, 1e-12))
    about = "what the named effects leave over"
    checks = [
        Check("excess", about, float(left[output]), rules.excess, bool(left[output] < rules.excess)),
        Check("explained", "what they remove", share, rules.explained, share >= rules.explained),
    ]
    found = any(check.holds for check in checks) or (seen.noise_explains and not seen.learned)
    if found and seen.surprise is not None:
        as_promised = seen.surprise <= rules.surprise
        checks.append(Check("surprise", "free runs over their bands", seen.surprise, rules.surprise, as_promised))
        found = as_promised
    return "effect_found" if found else "unexplained", tuple(checks)


@dataclass(frozen=True)
class Decision:
    """What the rules make of the evidence.

    Attributes:
        outcome: what the data say.
        names: of the effects that are trusted.
        checks: every rule as it was applied.
        lacking: what these rules would have asked for and the evidence does not hold; None where it holds all.
    """

    outcome: Outcome
    names: tuple[str, ...]
    checks: tuple[Check, ...]
    lacking: str | None = None


def decide(evidence: CaseEvidence, rules: DecisionRules = RULES) -> Decision:
    """Decide a case.

    Args:
        evidence: all that is known of it.
        rules: the thresholds; other ones than those by which it was gathered may ask for more than it holds.
    """
    checks: list[Check] = []
    lacking: list[str] = []
    for number, this in enumerate(evidence.rounds, start=1):
        checks += [tie(name, np.array(behind), rules) for name, behind in this.behind.items()]
        supported = [support(seen, rules) for seen in this.asked]
        checks += [check for those in supported for check in those]
        last = number == len(evidence.rounds)
        first = next((i for i, those in enumerate(supported) if all(c.holds for c in those)), None)
        accepted = all(c.holds for c in support(this.asked[-1])) if this.asked else False
        if (first is not None) != accepted or (first is not None and first != len(supported) - 1):
            lacking.append(f"round {number}: another candidate would be accepted")
        elif this.rivals and not last and leader(this.rivals, rules)[0].name != this.asked[-1].name:
            lacking.append(f"round {number}: another candidate would lead")
    if evidence.challenge.left is not None:
        checks += only_noise(evidence.challenge.left, rules)
    question = next_question(evidence.challenge, rules)
    if question is not None:
        lacking.append(f"a learned term {question}")
    names = evidence.final.names
    if evidence.challenge.names:
        stand = names_stand(evidence.challenge, rules)
        checks += stand
        if any(check.holds for check in stand) != bool(names):
            lacking.append("the final model where names are trusted otherwise")
    outcome, last_checks = conclude(evidence.final, rules)
    return Decision(outcome, names, (*checks, *last_checks), lacking[0] if lacking else None)
