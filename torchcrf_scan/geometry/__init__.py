"""Rigid motions of the plane."""
