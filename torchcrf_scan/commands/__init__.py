"""The subcommands of `torchcrf-scan`, one module each: typed functions whose options come from signature and docstring."""
