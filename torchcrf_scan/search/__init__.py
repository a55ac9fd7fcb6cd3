"""InitialiseRT as loops: the background, what it leaves open, hypothesised movers, and the start of the rounds."""
