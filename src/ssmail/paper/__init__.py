"""The paper's results: a module for each figure with the claim that is read off it, and the report of all."""
