"""inflight/design."""
