"""Free runs before and after attribution, and residual tests."""
