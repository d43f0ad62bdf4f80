"""tasks/pipelines/states."""
