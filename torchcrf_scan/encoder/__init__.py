"""A small convolutional encoder over the points of a scan: learned log potentials of movers and outliers."""
