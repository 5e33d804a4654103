"""Quasi-static logs: twist against slowly changing joint torque, fitted without inertia.

log -> prepare -> average -> fit of each curve -> intervals -> choice by held-out stretches -> report
"""
