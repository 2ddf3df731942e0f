"""A deployment as a chain, command to drive to motion to observation, and retraining on what it lacks."""
