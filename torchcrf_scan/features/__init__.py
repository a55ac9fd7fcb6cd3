"""Features and potentials of both chains, in tensors."""
