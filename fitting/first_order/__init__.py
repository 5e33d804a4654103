"""Linearisation of a fit along its motion, shared by screening, learned terms, evidence and clock alignment."""
