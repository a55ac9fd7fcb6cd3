"""Schedules, starts and couplings other than the defaults, and the register that loads them by name."""
