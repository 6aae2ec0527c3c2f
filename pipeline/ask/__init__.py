"""Questions to the results of a mission, from a person's words to answers in words and numbers; below all stages."""
