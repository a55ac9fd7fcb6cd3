"""The error for what cannot be used: one family, so that a caller can tell bad input from a fault of the package."""


class TorchCRFScanError(ValueError):
    """A scan, file, setting or model that cannot be used; the message names it, what was expected, and what was given."""
