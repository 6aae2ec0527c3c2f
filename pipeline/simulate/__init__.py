"""Stage simulate: mission logs out of simulated worlds."""
