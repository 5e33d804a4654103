"""Design of the next experiment, to separate ties or determine alpha."""
