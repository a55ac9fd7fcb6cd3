"""torchcrf_scan."""

__version__ = "0.1.0"
