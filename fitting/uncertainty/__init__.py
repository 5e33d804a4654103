"""Uncertainty of parameters and predictions, identifiability, and noise models."""
