"""The rounds of one pair as loops, from a start to the prediction, without gradients."""
