"""What a run is: specs, their sections and keys, and experiments.yaml, which they are built from."""
