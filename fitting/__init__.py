"""Identification of harmonic drives from measured logs."""
