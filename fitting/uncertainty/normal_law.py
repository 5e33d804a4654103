"""Quantile of the normal distribution for intervals."""

NORMAL_95 = 1.959963984540054
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""
