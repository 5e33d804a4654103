"""Attribution of a residual to effects: candidates, scores and decisions."""
