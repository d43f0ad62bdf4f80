"""tasks/pipelines/relation."""
