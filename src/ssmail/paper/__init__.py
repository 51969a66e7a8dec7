"""The results of the paper: one module for each figure with the claim that is read off it, and the report on all."""
