"""tasks/archive."""
