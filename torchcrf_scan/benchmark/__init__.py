"""Costs of the model: whole pairs by size, batch and threads, learning, memory, rivals in the same run, and the limit.

`torchcrf-scan bench` combines the parts (`study.py`). All tasks are timed in turns (`timing.py`), so that other load on the
machine affects all alike.
"""
