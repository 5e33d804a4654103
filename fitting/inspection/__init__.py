"""What a log that nobody has described holds: columns, signals, units, and what a fit could tell from it."""
