"""How well a set of effects explains the measurement, which sets are worth a fit, and which ranges explain it."""
