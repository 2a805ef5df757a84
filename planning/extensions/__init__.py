"""Our additions to Algorithm 1, one file each; a planner leaves each of them out with None, false or 0."""
