"""Kernels on numbers and arrays, independent of features: machine code, angles, motions, nearest points, chains."""
