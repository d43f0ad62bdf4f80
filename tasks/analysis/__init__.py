"""tasks/analysis."""
