"""Expert trajectories: made, scaled, saved."""
