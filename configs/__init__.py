"""Numbers and the only Hydra syntax: a folder per choice, a yaml per option. A package, so that the wheel has it."""
