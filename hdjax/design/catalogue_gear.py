"""The size of a catalogue's gear as a variable."""

from collections.abc import Mapping

from jaxtyping import Array

from hdjax.design.case import Case
from hdjax.design.study import Maker
from hdjax.design.vendor import gear

SIZE = "size"


class CatalogueGear(Maker):
    """A chosen `size` sets K and alpha as the vendor's table has them; the other variables set themselves.

    Where B_sp is not chosen, the damping is kept as a share of the critical, which mounted gears have in common
    (assumed).
    """

    def __call__(self, case: Case, chosen: Mapping[str, Array]) -> Case:
        ratio = case.drive.mu / case.drive.omega_0
        found = gear(chosen[SIZE])
        made = case.replace({"K": found.K, "alpha": found.alpha} | {p: v for p, v in chosen.items() if p != SIZE})
        if "B_sp" in chosen:
            return made
        return made.replace({"B_sp": ratio * made.drive.omega_0 / made.drive.c})
