"""Files in, files out: the only layer that knows paths, MCAP, Arrow, wall clocks and processes."""
