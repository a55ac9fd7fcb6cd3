"""The subcommands of `torchcrf-scan`, a module each: typed functions whose signature and docstring are their options."""
