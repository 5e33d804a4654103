"""Readers: from log files to signals in SI units on one time base."""
