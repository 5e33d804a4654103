"""Free runs, before and after, and tests of residuals."""
