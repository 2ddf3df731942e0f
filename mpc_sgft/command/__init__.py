"""From a command line to one checked config, and errors in one line."""
