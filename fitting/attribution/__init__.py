"""Which effect explains what a model leaves over: candidates inside the equations, scores, decisions."""
