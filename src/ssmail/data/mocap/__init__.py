"""Noisy Mocap (sections 4.1, B.3): people walking, from the CMU motion capture database."""
