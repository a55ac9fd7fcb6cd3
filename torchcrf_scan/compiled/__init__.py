"""The same answers in machine code, for one pair at a time on a CPU (numba, extra `fast`); the eager modules are the reference.

Every module here does what the module of `inference` or `features` with the same name does, in loops instead of tensors, in double
precision, and without gradients. Nothing here is imported unless it is used.
"""
