"""All endings of a simulation, with cause and remedy."""

import enum


class Ending(enum.IntEnum):
    """How a simulation ended."""

    successful = 0
    step_limit = 1
    step_too_small = 2
    not_finite = 3
    solver_failed = 4

    @property
    def message(self) -> str:
        """Cause and remedy."""
        return _MESSAGES[self]


_MESSAGES = {
    Ending.successful: "the simulation reached its end",
    Ending.step_limit: "the simulation used up its steps: raise max_steps, or loosen rtol and atol",
    Ending.step_too_small: (
        "the step size fell below its minimum: the equations are too stiff or discontinuous for this "
        "solver; smooth the effect (a larger transition speed) or use an implicit solver"
    ),
    Ending.not_finite: (
        "the motion grew beyond all numbers: check the sign of alpha (negative alpha escapes beyond "
        "|x| = 1/sqrt(-alpha)), the units of the torque, or take smaller steps"
    ),
    Ending.solver_failed: "the implicit solver did not converge: take smaller steps or another solver",
}


class SimulationError(RuntimeError):
    """A simulation that did not reach its end, with its [`Ending`][]."""

    def __init__(self, ending: Ending):
        super().__init__(ending.message)
        self.ending = ending
