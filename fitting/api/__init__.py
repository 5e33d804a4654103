"""Public interface of `fitting`: from logs to results."""
