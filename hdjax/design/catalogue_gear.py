"""Size of a catalogue gear as a design variable."""

from collections.abc import Mapping

from jaxtyping import Array

from hdjax.design.case import Case
from hdjax.design.study import Maker
from hdjax.design.vendor import gear

SIZE = "size"


class CatalogueGear(Maker):
    """The variable `size` sets K and alpha from the vendor's table; other variables are set as usual.

    If B_sp is not a variable, the damping ratio is constant, as for mounted gears (assumed).
    """

    def __call__(self, case: Case, chosen: Mapping[str, Array]) -> Case:
        ratio = case.drive.mu / case.drive.omega_0
        found = gear(chosen[SIZE])
        made = case.replace({"K": found.K, "alpha": found.alpha} | {p: v for p, v in chosen.items() if p != SIZE})
        if "B_sp" in chosen:
            return made
        return made.replace({"B_sp": ratio * made.drive.omega_0 / made.drive.c})
