"""The response to harmonic forcing: analytic, by harmonic balance, and in the time domain."""
