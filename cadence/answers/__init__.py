"""Questions to mission hypotheses, and their answers: pure functions of `cadence.stories.Stories`, each with its error."""
