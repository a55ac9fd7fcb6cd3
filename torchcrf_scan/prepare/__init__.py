"""Machine code built ahead of time: what it is built for, how, and by which processes."""
