"""Many missions: tasks, engines that run them, and what became of each."""
