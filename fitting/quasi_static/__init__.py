"""Quasi-static logs: twist against slowly changing joint torque, fitted without inertia.

fit:        log -> prepare -> average -> fit of each curve -> intervals -> choice by held-out stretches -> report
close-loop: log -> prepare -> points -> straight line -> screening -> refits, repeated -> strengths -> report
"""
