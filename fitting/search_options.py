"""Settings of the search for effects. Separate, so that the command line needs no import of JAX."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchOptions:
    """Settings of the search for effects.

    Attributes:
        max_effects: Most effects to add.
        seed: Of the surrogates for p-values.
        thorough: Refit every form of the catalogue in each round, not only those that screening finds likely (minutes).
    """

    max_effects: int = 3
    seed: int = 0
    thorough: bool = False
