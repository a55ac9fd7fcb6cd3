"""What the model costs: whole pairs by size, batch and threads, learning, memory, rivals in the same run, and the limit.

`torchcrf-scan bench` puts the parts together (`study.py`). Everything is timed in turns (`timing.py`), so that other load on the
machine falls on all alike.
"""
