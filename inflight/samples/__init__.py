"""inflight/samples."""
