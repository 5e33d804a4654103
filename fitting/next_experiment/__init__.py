"""The experiment that would decide what the logs leave open."""
