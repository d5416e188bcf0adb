"""Physics as the estimator: which known craft, how turned, where and of what explains an echo, and how surely."""
