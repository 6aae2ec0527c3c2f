"""Where the tasks of a batch run: an engine takes tasks and gives outcomes as they finish; it knows nothing of stages."""
