"""Choice of the forms that are refitted, from screening alone."""

import numpy as np

from fitting.attribution.screening import Lead, Screen
from fitting.attribution.shortlist import first_of_each_family, further_forms, possible_ties, worth_a_refit
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.backlash import Backlash, UndampedBacklash
from hdjax.effects.creep import Creep
from hdjax.effects.hysteresis import BoucWen, MaxwellSlip
from hdjax.effects.stiffness import QuadraticStiffness

CREEP = Lead(Creep(k=1.0, tau=1.0, span=1.0), {}, 1.0)
QUADRATIC = Lead(QuadraticStiffness(), {}, 0.5)
BIAS = Lead(TorqueBias(), {}, 0.01)
UNDAMPED, GAP = Lead(UndampedBacklash(b=0.0), {}, 0.002), Lead(Backlash(b=0.0), {}, 0.001)
SCREEN = Screen((CREEP, QUADRATIC, BIAS, UNDAMPED, GAP), np.zeros(199))


def test_form_with_too_small_gain_is_not_refitted():
    assert worth_a_refit(SCREEN, least=1e-4) == [CREEP, QUADRATIC]


def test_form_with_gain_explained_by_chance_is_refitted_only_if_it_is_the_best():
    assert worth_a_refit(Screen(SCREEN.leads, np.full(199, 2.0)), least=1e-4) == [SCREEN.leads[0]]


def test_suspect_family_is_refitted_in_any_case():
    """First one form of the family is refitted; its other forms follow if that one is the best."""
    assert first_of_each_family([CREEP, QUADRATIC]) == [CREEP, QUADRATIC]
    assert first_of_each_family([CREEP, QUADRATIC], [UNDAMPED, GAP]) == [CREEP, QUADRATIC, UNDAMPED]
    assert further_forms([CREEP, UNDAMPED, GAP], ["backlash"], [CREEP, UNDAMPED]) == [GAP]


def test_suspect_family_is_refitted_once():
    assert first_of_each_family([CREEP, GAP], [UNDAMPED]) == [CREEP, GAP]


def test_catalogue_order_decides_between_equal_first_order_gains():
    """To first order, backlash with and without damping is the same, so that rounding would decide."""
    same = [Lead(UndampedBacklash(b=0.0), {}, 0.002 * (1.0 + 1e-13)), Lead(Backlash(b=0.0), {}, 0.002)]
    assert first_of_each_family(same) == same[1:]
    more = [Lead(UndampedBacklash(b=0.0), {}, 0.002), Lead(Backlash(b=0.0), {}, 0.002 * (1.0 - 1e-3))]
    assert first_of_each_family(more) == more[:1]


def test_ties_include_forms_that_are_equal_to_first_order():
    equal = Lead(UndampedBacklash(b=0.0), {}, GAP.gain * (1.0 + 1e-13))
    assert possible_ties([CREEP, QUADRATIC, GAP, equal], [CREEP, QUADRATIC, GAP]) == [QUADRATIC]
    assert possible_ties([CREEP, QUADRATIC, GAP, equal], [CREEP, QUADRATIC, GAP], [GAP]) == [QUADRATIC, GAP, equal]


def test_form_with_several_states_needs_a_far_larger_gain_to_go_first():
    slip = Lead(MaxwellSlip(yield_twist=1.0, settling=1.0), {}, 1.0)
    near, far = (Lead(BoucWen(memory_twist=1.0), {}, gain) for gain in (0.3, 0.2))
    assert first_of_each_family([slip, near]) == [near]
    assert first_of_each_family([slip, far]) == [slip]
