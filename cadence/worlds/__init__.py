"""Worlds that make missions: terrain, ways, sensors, and who moves among them."""
