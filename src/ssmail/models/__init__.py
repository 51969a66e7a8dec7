"""The networks of section 3.2, for any number of agents, batched over trajectories and steps."""
