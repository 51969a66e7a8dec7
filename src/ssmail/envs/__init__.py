"""Environments: what an action does to a state."""
