"""Inference in tensors: messages, motions and the rounds of Algorithm 1."""
