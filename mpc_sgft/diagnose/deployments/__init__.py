"""A deployment's run folder, read as a chain: command to drive, drive to motion, motion to observation."""
