"""Losses: pure functions from tensors to a scalar and its terms."""
