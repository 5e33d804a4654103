"""Least squares over segments of logs: parameters, initial states and residual."""
