"""How effects are searched for. Apart, so that a command line has it without loading JAX."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchOptions:
    """How effects are searched for.

    Attributes:
        max_effects: Effects to add at most.
        seed: Of the surrogates behind the p-values.
        thorough: Refit every form of the catalogue in each round, in place of those that a first-order look finds
            likely (minutes).
    """

    max_effects: int = 3
    seed: int = 0
    thorough: bool = False
