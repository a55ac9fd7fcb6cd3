"""Readers and writers of pairs, recordings and predictions, and the simulator."""
