"""Configuration: the spec of a run, its sections and keys, and experiments.yaml, which specs are built from."""
