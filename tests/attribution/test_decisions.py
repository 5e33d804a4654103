"""Decisions: pure functions of the evidence and the rules."""

import ast
import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import fitting
from fitting.attribution.case_evidence import (
    CaseEvidence,
    ChallengeEvidence,
    EffectEvidence,
    FinalEvidence,
    ModelEvidence,
    Rival,
    RoundEvidence,
    case_evidence,
    stored_evidence,
)
from fitting.attribution.decisions import conclude, decide, leader, support, tie
from fitting.attribution.rules import RULES
from fitting.report.rules import rules_page
from undeclared.replay import OFF, differing

SEEN = EffectEvidence("friction", 1.0, 0.005)
MODEL = ModelEvidence(-1.0, -1.0, 3, (1.0, 1.0), True)
CHALLENGE = ChallengeEvidence(MODEL, MODEL, 1, -1.0, False)
FINAL = FinalEvidence(("friction",), False, (1.0, 1.0), (9.0, 9.0))
CASE = CaseEvidence((RoundEvidence((SEEN,), {"friction": (0.0,) * 9}, (), {"friction": 0.3}),), CHALLENGE, FINAL)


@pytest.mark.parametrize(
    ("change", "failed"),
    [
        ({}, None),
        ({"gain": 1e-4}, "least_gain"),
        # Noise explains the residual: the likelihood against it decides.
        ({"gain": 1e-4, "over_noise": 20.0}, None),
        ({"p_value": 0.02}, "significance"),
        ({"removed": 0.01, "imperfection": 0.02}, "imperfection"),
        ({"strength_errors": 3.0}, "strength_errors"),
        ({"over_noise": 2.0}, "noise_gain"),
        ({"at_bounds": 1}, "at_bounds"),
    ],
)
def test_each_rule_of_support_can_reject_an_effect(change: dict, failed: str | None):
    checks = support(replace(SEEN, **change))
    assert [c.rule for c in checks if not c.holds] == ([failed] if failed else [])


def test_candidates_tie_if_scatter_over_blocks_explains_their_difference():
    random = np.random.default_rng(0)
    scatter = random.normal(size=30)
    assert tie("a", scatter - scatter.mean()).holds
    assert not tie("a", scatter + 2.0).holds
    # Slightly worse in every block is no tie.
    assert not tie("a", 0.1 + 0.01 * scatter).holds
    # Worse by the same in each block is no tie, but a single block is one.
    assert not tie("a", np.full(4, 9.0)).holds
    assert tie("a", np.full(1, 9.0)).holds


def test_effect_with_a_parameter_at_its_bound_in_the_final_fit_explains_nothing():
    assert conclude(FINAL)[0] == "effect_found"
    outcome, checks = conclude(replace(FINAL, at_bounds=1))
    assert outcome == "unexplained" and not next(c for c in checks if c.rule == "at_bounds").holds


def test_difference_below_the_least_gain_is_a_tie():
    worse = np.full(4, 9.0)
    assert tie("a", worse, 0.5 * RULES.least_gain).holds
    assert not tie("a", worse, 2.0 * RULES.least_gain).holds


def test_replay_knows_the_gain_that_a_tied_candidate_lacks():
    (this,) = CASE.rounds
    for lost, holds in ((0.5 * RULES.least_gain, True), (2.0 * RULES.least_gain, False)):
        worse = replace(this, behind={"other": (9.0,) * 9}, lost={"other": lost})
        check = next(c for c in decide(replace(CASE, rounds=(worse,))).checks if c.about == "other")
        assert check.holds is holds


def test_tie_test_keeps_its_level():
    random = np.random.default_rng(1)
    draws = random.normal(size=(4000, 12))
    told = np.mean([not tie("a", draw).holds for draw in draws])
    assert told == pytest.approx(RULES.tie_level, abs=0.012)


def test_simplest_plausible_candidate_leads_among_equal_gains():
    one = Rival("one", 1.0, 2.0, True, 5, 2, True, False)
    other = replace(one, name="other", long_gain=2.01, parameters=7)
    assert leader([other, one])[0].name == "one"
    assert leader([replace(other, long_gain=3.0), one])[0].name == "other"
    assert leader([other, replace(one, plausible=False)])[0].name == "other"
    # Equal over whole stretches, where errors accumulate, but not over short segments.
    assert leader([other, replace(one, gain=0.7, tied=False)]) == (other, ("other",))
    assert leader([other, replace(one, gain=0.99, tied=False)])[0].name == "one"


@pytest.mark.parametrize(
    ("change", "outcome"),
    [
        ({}, "effect_found"),
        ({"excess": (1.0, 4.0)}, "unexplained"),
        ({"excess": (1.0, 4.0), "noise_explains": True}, "effect_found"),
        ({"surprise": 2.0, "free_runs_explained": 0.5}, "unexplained"),
        ({"surprise": 2.0, "free_runs_explained": 0.95}, "effect_found"),
        ({"surprise": 2.0, "free_runs_explained": 0.95, "noise_explains": True}, "unexplained"),
        ({"surprise": 1.1, "free_runs_explained": 0.5}, "effect_found"),
        ({"names": ()}, "model_sufficient"),
        ({"names": (), "learned": True}, "unexplained"),
        ({"names": (), "excess": (1.0, 2.0)}, "unexplained"),
        ({"names": (), "excess": (1.0, 2.0), "noise_explains": True}, "model_sufficient"),
    ],
)
def test_conclusion_follows_from_names_excess_and_free_runs(change: dict, outcome: str):
    assert conclude(replace(FINAL, excess_at_first=(1.0, 9.0), **change))[0] == outcome


def test_evidence_against_replaced_names_gives_the_same_decision():
    """A learned term replaced names that do not explain free runs."""
    final = replace(FINAL, surprise=2.0, free_runs_explained=0.5, replaced=True)
    told = decide(replace(CASE, final=final))
    assert (told.outcome, told.names, told.lacking) == ("unexplained", (), None)
    assert {c.rule for c in told.checks if not c.holds} >= {"surprise", "free_run_explained"}
    lenient = decide(replace(CASE, final=final), replace(RULES, surprise=3.0))
    assert (lenient.outcome, lenient.names) == ("effect_found", FINAL.names)


def test_stored_evidence_gives_the_same_decision():
    again = case_evidence(json.loads(json.dumps(stored_evidence(CASE))))
    assert decide(again) == decide(CASE)
    assert decide(CASE).outcome == "effect_found" and decide(CASE).lacking is None
    stricter = decide(again, replace(RULES, significance=1e-3))
    assert stricter.lacking == "round 1: another candidate would be accepted"


@pytest.mark.parametrize(
    "case",
    [
        # The noise model diverges beside a candidate.
        replace(CASE, rounds=(RoundEvidence((replace(SEEN, over_noise=-np.inf),)),)),
        # Free runs of the names diverge, and those of the learned term in their place do not.
        replace(CASE, challenge=replace(CHALLENGE, instead=MODEL, longer_worse=-np.inf)),
        replace(CASE, final=replace(FINAL, surprise=np.inf, free_runs_explained=-np.inf)),
    ],
)
def test_stored_evidence_keeps_the_sign_of_infinity(case: CaseEvidence):
    text = json.dumps(stored_evidence(case), allow_nan=False)
    assert decide(case_evidence(json.loads(text))) == decide(case)


def test_replay_accepts_a_round_whose_leader_is_not_supported():
    """The leader over whole stretches is asked first; here the data support only the next candidate."""
    rivals = tuple(
        Rival(name, 1.0, gain, True, 5, 2, True, False) for name, gain in (("spring", 3.0), ("friction", 1.0))
    )
    first = RoundEvidence((replace(SEEN, name="spring", strength_errors=1.0), SEEN), rivals=rivals)
    second = RoundEvidence((replace(SEEN, name="other", p_value=0.5),))
    assert decide(replace(CASE, rounds=(first, second))).lacking is None
    unasked = replace(first, asked=(SEEN,))
    assert decide(replace(CASE, rounds=(unasked, second))).lacking == "round 1: another candidate would lead"


def test_every_rule_has_a_unit_a_meaning_and_a_source():
    for rule in fields(RULES):
        assert all(rule.metadata[key] for key in ("unit", "meaning", "source")), rule.name


def test_page_of_rules_is_up_to_date():
    page = Path(fitting.__file__).parents[1] / "docs" / "rules.md"
    assert page.read_text(encoding="utf-8") == rules_page()


# Numbers that are not thresholds of a decision: neutral elements, halves, and amounts of work.
_PLAIN = {0, 1, 2, -1, 0.5, 1e-12, 1e-300, 1e-6}


def test_deciding_modules_compare_with_rules_only():
    """Literals of the modules that decide: each comparison takes its threshold from the rules."""
    room = Path(fitting.__file__).parent
    deciding = ["discrepancy/challenge.py", "conclusion.py", "attribution/effect_search.py"]
    deciding += ["attribution/support.py", "validation/free_run_check.py"]
    for name in deciding:
        tree = ast.parse((room / name).read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Compare):
                literals = [n.value for n in ast.walk(node) if isinstance(n, ast.Constant)]
                numbers = [v for v in literals if isinstance(v, int | float) and not isinstance(v, bool)]
                assert set(numbers) <= _PLAIN, (name, node.lineno, numbers)


def test_replay_switches_off_existing_rules_and_reports_differences():
    assert set(OFF) <= {rule.name for rule in fields(RULES)}
    cases = {"one": CASE}
    assert differing(cases, RULES) == {}
    assert differing(cases, replace(RULES, significance=1e-3)) == {
        "one": "round 1: another candidate would be accepted"
    }
    unsure = replace(CASE, final=replace(FINAL, surprise=1.2, free_runs_explained=0.5))
    assert differing({"one": unsure}, replace(RULES, surprise=1.1)) == {"one": "effect_found -> unexplained"}
