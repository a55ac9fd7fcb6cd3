"""Simpler methods for comparison."""
