"""The nominal model, and measured windows simulated with it."""
