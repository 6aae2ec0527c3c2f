"""What channels and message types mean, by guess or as the user states."""
