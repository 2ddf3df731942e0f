"""Scripts that time: side by side in one run, as ratios."""
