"""One file each method of deployment: what freezes, what it learns from, its objective, its planner, its gate."""
