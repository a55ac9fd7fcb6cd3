"""Metrics of predictions, and tables of methods."""
