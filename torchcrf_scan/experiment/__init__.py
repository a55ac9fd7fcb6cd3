"""The paper's experiment: folds, every method on every fold, tables and ablations."""
