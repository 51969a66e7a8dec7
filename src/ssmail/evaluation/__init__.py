"""Metrics of free-running rollouts, and which of them are reported."""
