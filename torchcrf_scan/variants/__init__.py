"""Schedules, starts and couplings beside the default ones, and the register that loads them by name."""
