"""What the model costs: time by stage, size, batch and threads, memory, rivals in the same run, and how far from the limit it is.

`torchcrf-scan bench` puts the parts together (`study.py`). Everything is timed in turns (`timing.py`), so that what else the
machine does falls on all alike.
"""
