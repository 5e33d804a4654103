"""Which forms are refitted, from the first look alone."""

import numpy as np

from fitting.attribution.screening import Lead, Screen
from fitting.attribution.shortlist import first_of_each_family, further_forms, worth_a_refit
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


def test_what_explains_too_little_is_not_worth_a_refit():
    assert worth_a_refit(SCREEN, least=1e-4) == [CREEP, QUADRATIC]


def test_what_chance_does_as_well_is_not_either():
    assert worth_a_refit(Screen(SCREEN.leads, np.full(199, 2.0)), least=1e-4) == []


def test_a_suspect_is_there_however_little_it_explains():
    """One form of its family; the others compete where that one is the best."""
    assert first_of_each_family([CREEP, QUADRATIC]) == [CREEP, QUADRATIC]
    assert first_of_each_family([CREEP, QUADRATIC], [UNDAMPED, GAP]) == [CREEP, QUADRATIC, UNDAMPED]
    assert further_forms([CREEP, UNDAMPED, GAP], ["backlash"], [CREEP, UNDAMPED]) == [GAP]


def test_a_suspect_that_is_a_lead_already_is_not_there_twice():
    assert first_of_each_family([CREEP, GAP], [UNDAMPED]) == [CREEP, GAP]


def test_of_what_is_the_same_to_first_order_the_catalogues_first_form_goes_first():
    """A gap without damping shows nothing of it to first order, and rounding decides which form leads."""
    same = [Lead(UndampedBacklash(b=0.0), {}, 0.002 * (1.0 + 1e-13)), Lead(Backlash(b=0.0), {}, 0.002)]
    assert first_of_each_family(same) == same[1:]
    more = [Lead(UndampedBacklash(b=0.0), {}, 0.002), Lead(Backlash(b=0.0), {}, 0.002 * (1.0 - 1e-3))]
    assert first_of_each_family(more) == more[:1]


def test_a_form_of_several_states_goes_first_only_where_it_explains_far_more():
    slip = Lead(MaxwellSlip(yield_twist=1.0, settling=1.0), {}, 1.0)
    near, far = (Lead(BoucWen(memory_twist=1.0), {}, gain) for gain in (0.3, 0.2))
    assert first_of_each_family([slip, near]) == [near]
    assert first_of_each_family([slip, far]) == [slip]
