"""Everything drawn: the rerun viewer, value maps, films."""
