"""Nonparametric terms, learned where no named effect explains the model discrepancy."""
