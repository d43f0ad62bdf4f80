"""inflight/lsq."""
