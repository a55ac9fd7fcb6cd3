"""Ahead-of-time build of machine code: argument layouts, compilation, and the processes that build."""
