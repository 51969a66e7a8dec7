"""Training: the learners of all methods, rollouts, curricula, evaluators, and the loop."""
