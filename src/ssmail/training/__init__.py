"""Training: the learner, rollouts, curricula, replay, and the loop that yields metrics."""
