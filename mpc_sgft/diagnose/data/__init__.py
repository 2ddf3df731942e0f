"""Measured episodes, and what can be said of them without a model of the world."""
