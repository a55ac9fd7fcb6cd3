"""Scans one by one: ego motion, moving points and tracked objects."""
