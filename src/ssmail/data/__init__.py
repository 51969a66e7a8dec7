"""Expert trajectories: generated or recorded, scaled, saved."""
