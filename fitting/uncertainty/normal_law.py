"""The normal law's one number that intervals need."""

NORMAL_95 = 1.959963984540054
"""Standard errors to either side that hold 95 % of a normal law."""
