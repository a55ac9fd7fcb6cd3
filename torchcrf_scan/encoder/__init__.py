"""A small convolutional encoder over the points of a scan, which says what of them moves and what has no counterpart."""
