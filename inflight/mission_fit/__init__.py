"""inflight/mission_fit."""
