"""What a run leaves on disk: episodes, checkpoints, metrics, its folder."""
