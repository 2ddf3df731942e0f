"""How well a set of effects explains the measurement, and which sets are worth a fit."""
