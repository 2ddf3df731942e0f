"""Where an action goes: the simulator, or a robot."""
