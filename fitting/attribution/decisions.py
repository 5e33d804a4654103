"""Every decision of the loop: the rules with their thresholds, and what they make of the evidence.

Nothing here fits, simulates or reads: the same evidence and the same rules give the same decision, so that stored
evidence can be decided anew under other rules.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

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

Outcome = Literal["effect_found", "model_sufficient", "unexplained"]


def _rule(default: float, unit: str, meaning: str, source: str) -> Any:
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "source": source})


_UNDECLARED = "study of undeclared effects, `docs/evaluation_history.md`"


@dataclass(frozen=True)
class DecisionRules:
    """Every threshold that decides something; `docs/rules.md` is made of the fields."""

    significance: float = _rule(
        0.01,
        "1",
        "largest chance that the best of the catalogue gains as much where nothing is missing",
        "convention; at 0.01 at most one false alarm in a hundred looks",
    )
    least_gain: float = _rule(
        1e-3,
        "log of rms error",
        "smallest decrease of the error that counts: a tenth of a percent",
        "an imperfection of the solver counts for as much",
    )
    tie_level: float = _rule(
        0.05,
        "1",
        "chance at which a candidate counts as worse than the best one, by a paired t test over blocks",
        "convention",
    )
    same_gain: float = _rule(
        0.02, "share of the best gain", "gains over whole stretches that differ by less are the same", _UNDECLARED
    )
    strength_errors: float = _rule(
        3.9,
        "standard errors",
        "by which a strength must differ from zero",
        "one percent of chance over a hundred forms and shapes (Bonferroni)",
    )
    at_bounds: float = _rule(
        0.0,
        "parameters",
        "of an effect that may have ended at a bound: beyond it the law makes no sense, so that it names nothing",
        "bounds are in the code of each effect",
    )
    excess: float = _rule(
        1.5, "times the noise", "a residual larger than this is not noise", "the noise is known to a few per cent"
    )
    explained: float = _rule(
        0.99,
        "share of variance",
        "of the error beyond noise that found effects must remove to be the explanation",
        "a tenth of the error; 0.9986 on Silverbox, and 0.99 changes none of 40 cases of the study (seed 95)",
    )
    quasi_static_explained: float = _rule(
        0.9,
        "share of variance",
        "likewise of quasi-static logs, whose laws err by more",
        "0.96 for the hysteresis of a measured joint (`docs/quasi_static.md`)",
    )
    little: float = _rule(
        0.05,
        "share of the gain",
        "what a learned term adds to names, or names leave beyond noise, is little below this share of their gain",
        _UNDECLARED,
    )
    come_out: float = _rule(
        0.75,
        "share of mean square",
        "of a learned term that named effects must make up for it to have come out as them",
        _UNDECLARED,
    )
    lasting: float = _rule(
        0.1,
        "log of rms error",
        "by which free runs of a learned term may be worse than those of the names that it would replace",
        "a lag in the place of creep left 40 times as much (study, seed 95)",
    )
    many: float = _rule(3.0, "names", "so many names may be the terms of one function", _UNDECLARED)
    noise_gain: float = _rule(
        5.0,
        "nats",
        "log likelihood by which an effect, or noise of the torque, must better noise that would explain as much",
        "the best of fifty forms gains 4 by chance",
    )
    innovations: float = _rule(
        0.03,
        "share of variance",
        "of a Kalman filter's innovations that earlier ones may predict where all that is left is noise",
        "below 0.01 under noise, above 0.06 where an effect is missing (`tests/uncertainty/test_noise_model.py`)",
    )
    free_run_explained: float = _rule(
        0.9,
        "share of variance",
        "of the free runs' error beyond noise that effects must remove for their bands not to be asked",
        "laws are not exact, and bands know nothing of that",
    )
    surprise: float = _rule(
        1.25,
        "times the band",
        "free runs that are farther off than this are not what the model promised",
        "a right model stays within 1.2 (`tests/validation/test_free_run_check.py`)",
    )

    line_errors: float = _rule(
        5.0, "standard errors", "by which a spectral line is in a log", "one in 2e6 by chance, over some thousand lines"
    )
    line_share: float = _rule(
        0.25,
        "share of squares",
        "of what is left that a line must explain for the clocks of several logs to be set by it",
        "lines that a multisine leaves behind explain less each (`tests/attribution/test_log_alignment.py`)",
    )
    line_in_phase: float = _rule(
        0.9,
        "share of amplitude",
        "that a line of one phase keeps of what it has with a phase of each log's own where clocks are right",
        "phases within 0.45 rad",
    )
    coefficient: float = _rule(
        0.005,
        "log of rms error",
        "that a further coefficient of a learned function must gain on parts of the training data left out",
        "assumed: half a percent of the error",
    )
    variable: float = _rule(
        0.03, "log of rms error", "that a second variable of a learned function must gain", "assumed: three percent"
    )
    quasi_static_imperfection: float = _rule(
        0.05,
        "share of rms",
        "of what effects of quasi-static logs have removed that their laws may get wrong",
        "laws of hysteresis and stiffness are good to some hundredths (`docs/quasi_static.md`)",
    )
    wander: float = _rule(
        20.0,
        "times the noise",
        "by which a residual of quasi-static logs may wander and still be coloured noise",
        "an encoder's noise correlated by 0.98 from row to row would be nine times",
    )


RULES = DecisionRules()
"""The rules as they are."""


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
    least = most - max(rules.least_gain, rules.same_gain * most)
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


def rules_table(rules: DecisionRules = RULES) -> list[dict[str, Any]]:
    """The rules as rows: name, threshold, unit, meaning, source."""
    return [
        {"name": f.name, "threshold": getattr(rules, f.name)}
        | {k: f.metadata[k] for k in ("unit", "meaning", "source")}
        for f in fields(rules)
    ]
