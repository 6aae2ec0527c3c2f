"""What people want to know of a log before they use it."""
