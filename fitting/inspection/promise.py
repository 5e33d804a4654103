"""What a fit of a log could determine, from its signals and excitation."""

from collections.abc import Iterator

from fitting.inspection.excitation import Excitation
from fitting.inspection.inspection import Inspection

# rad^-2, of the piecewise stiffness in vendors' catalogues.
_ALPHAS = (1e5, 4.5e5)
_OUTPUTS = ("motor_angle", "motor_velocity", "load_angle", "load_velocity", "joint_torque")
_VISIBLE = 0.01  # change of stiffness below which alpha is hardly identifiable; assumed


def promises(inspection: Inspection, moved: Excitation) -> tuple[str, ...]:
    """Sentences on what a fit of the logs can and can't determine."""
    by_kind = {
        "drive": _of_drive,
        "motor side": _of_motor_side,
        "quasi-static": _of_quasi_static,
        "reduced": _of_reduced,
    }
    kind = inspection.joint.kind
    return tuple(by_kind[kind](inspection, moved) if kind is not None else _of_nothing(inspection))


def _of_drive(inspection: Inspection, moved: Excitation) -> Iterator[str]:
    current = "motor_torque" not in inspection.joint.signals
    yield (
        f"A drive log (both angles and a motor {'current' if current else 'torque'}): stiffness K, cubic coefficient "
        "alpha, mesh damping B_sp, and effects."
    )
    yield "It needs the inertias of motor and load: without them, stiffness and torque scale are confounded."
    if current:
        yield "The torque constant scales the inertias and K equally; a log does not determine it."
    yield from _of_alpha(moved)
    if moved.band is not None:
        yield (
            "B_sp and the inertias are determined near the resonance: it must lie inside the band of the torque "
            f"({moved.band[0]:.3g} to {moved.band[1]:.3g} Hz)."
        )
    yield from _of_resonances(moved)


def _of_resonances(moved: Excitation) -> Iterator[str]:
    """What the frequency response of the motor shows."""
    if moved.shows is None:
        return
    dip, peak = moved.shows.antiresonance, moved.shows.resonance
    if dip is not None and peak is not None:
        yield (
            f"The motor's response shows an antiresonance at about {dip:.3g} Hz and a resonance at {peak:.3g} Hz: with "
            "the scale of the torque they give K, J_l and J_m."
        )
    elif peak is not None:
        yield (
            f"The motor's response shows a resonance at about {peak:.3g} Hz, but no antiresonance below it: torque at "
            "lower frequencies would separate K, J_l and J_m."
        )
    elif dip is not None:
        yield (
            f"The motor's response shows an antiresonance at about {dip:.3g} Hz, which gives K/J_l, but no resonance "
            "above it: torque at higher frequencies would separate K, J_l and J_m."
        )
    else:
        yield (
            "The motor's response shows neither antiresonance nor resonance in the excited band: together they would "
            "separate K, J_l and J_m."
        )


def _of_alpha(moved: Excitation) -> Iterator[str]:
    if moved.twist is None:
        return
    share = (0.5 * moved.twist) ** 2
    low, high = (alpha * share for alpha in _ALPHAS)
    verdict = "may show" if high > _VISIBLE else "hardly shows"
    low, high = (float(f"{100 * change:.2g}") for change in (low, high))
    yield (
        f"The twist spans {moved.twist:.2g} rad: alpha {verdict}, since that of catalogue gears changes the stiffness "
        f"by {low:g} to {high:g} % there."
    )


def _of_motor_side(inspection: Inspection, moved: Excitation) -> Iterator[str]:
    has = [s for s in _OUTPUTS if s in inspection.joint.signals]
    if not any(s.startswith("motor") for s in has):
        yield f"One side alone ({' and '.join(has)} and torque): a fit needs the motor's motion."
        return
    side = "One side alone" if len(has) == 1 else "No twist"
    yield f"{side} ({' and '.join(has)} and torque): K, B_sp and inertias, where the torque reaches the resonance."
    yield "The motor side has antiresonance and resonance, which give both inertias and K with the ratio."
    if moved.band is not None:
        yield f"Both must lie inside the band of the torque ({moved.band[0]:.3g} to {moved.band[1]:.3g} Hz)."
    yield from _of_resonances(moved)
    yield "alpha and effects of the mesh are poorly determined: a second angle would help, so look for one in the log."


def _of_quasi_static(inspection: Inspection, moved: Excitation) -> Iterator[str]:
    yield "A quasi-static log (a twist and the joint torque): stiffness by torque, hysteresis, lost motion, ripple."
    yield "It determines neither damping nor inertias, and needs none."
    velocity = {"motor_angle", "load_angle"} <= set(inspection.joint.signals)
    if velocity:
        yield "The motion must be slow: torque that accelerates the load counts as torque through the gear."


def _of_reduced(inspection: Inspection, moved: Excitation) -> Iterator[str]:
    yield "A reduced log (a dynamic error and a forcing): mu, omega_0, alpha and a gain, in the log's units."
    yield "It determines neither K nor inertias, since the scale of the forcing is arbitrary."


def _of_nothing(inspection: Inspection) -> Iterator[str]:
    found = inspection.joint.signals
    has = ", ".join(found) if found else "no signal"
    yield f"The recognised signals ({has}) are not sufficient for a fit."
    yield (
        "A drive log needs motor torque and the motor's angle or velocity, a quasi-static one a twist (or both "
        "angles) and the joint torque, a reduced one a dynamic error and a forcing."
    )
