"""A deployment as a chain, command to drive to motion to observation, what explains it, and retraining on that."""
