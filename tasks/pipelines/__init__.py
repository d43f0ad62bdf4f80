"""tasks/pipelines."""
