"""The rounds of one pair as loops, from a start to the answer, without gradients."""
