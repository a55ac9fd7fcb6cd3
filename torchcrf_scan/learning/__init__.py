"""Learning: the staged fit, first-order training, calibration, and the run that does them."""
