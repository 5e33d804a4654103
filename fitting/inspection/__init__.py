"""Inspection of a log without a drive file: columns, signals, units, and what a fit could determine."""
