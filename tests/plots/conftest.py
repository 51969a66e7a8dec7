"""The hand-made databases of tests/paper serve here too."""

from tests.paper.conftest import AddRun, ablate, add_forecast, add_landscapes, add_run, add_trajectories, vary_alpha

__all__ = ["AddRun", "ablate", "add_forecast", "add_landscapes", "add_run", "add_trajectories", "vary_alpha"]
