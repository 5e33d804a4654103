"""Least squares over segments of logs: parameters, initial states, what is left over."""
