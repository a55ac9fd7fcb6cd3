"""Kernels on numbers and arrays that know nothing of features: machine code, angles, motions, nearest points, chains."""
