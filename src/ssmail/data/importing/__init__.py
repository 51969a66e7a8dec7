"""Anyone's recorded agents as an expert set: tables and arrays, tracks, windows, splits."""
