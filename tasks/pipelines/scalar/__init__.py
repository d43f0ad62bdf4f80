"""tasks/pipelines/scalar."""
