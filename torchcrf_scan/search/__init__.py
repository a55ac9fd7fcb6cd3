"""InitialiseRT as loops: registration of the background, hypothesised movers of the unexplained points, and the start."""
