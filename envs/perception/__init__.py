"""Where the object is, measured: a fixed pose, the stand-in, or cameras."""
