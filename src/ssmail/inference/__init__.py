"""Trained models in use: load the model of a run, forecast with it, and export it."""
