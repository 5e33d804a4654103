"""Does the loop find what was hidden? A rig that shares nothing with the catalogue, and the study around it."""
