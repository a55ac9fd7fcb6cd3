"""Gradients of the rounds: the way back through the loops of `torchcrf_scan.fast`, one pair at a time."""
