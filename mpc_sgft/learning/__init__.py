"""The world model, its objectives, replay, and the machinery that every method shares."""
