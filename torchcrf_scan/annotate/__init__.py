"""Annotation of scan pairs by hand, on a page in the browser: what each point is, and how each body moves."""
