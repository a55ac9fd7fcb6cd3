"""Where wrong points come from: one cause for each, what became of each mover, and what an outlier gate in metres would do."""
