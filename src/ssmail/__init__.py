"""ssmail: the experiments of "SS-MAIL: Self-Supervised Multi-Agent Imitation Learning", run, stored and redrawn."""

__version__ = "0.1.0"
