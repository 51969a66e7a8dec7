"""Files and arguments from strangers: mutations of valid ones, and crafted ones, one module per kind of input."""
