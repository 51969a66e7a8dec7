"""Neighbours: ssmail's environments for PettingZoo, and expert sets from PettingZoo and `imitation`."""
