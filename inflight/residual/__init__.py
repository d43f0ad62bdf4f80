"""inflight/residual."""
