"""Stage train: from episodes or synthetic motion to a checkpoint."""
