"""Measured episodes: read, checked, smoothed and cut into windows; nothing is simulated here."""
