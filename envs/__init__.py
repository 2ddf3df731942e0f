"""The world: what happens when an action is applied."""
