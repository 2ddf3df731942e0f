"""Numbers and the only Hydra syntax: one folder per choice, one yaml per option. A package, so that the wheel carries it."""
