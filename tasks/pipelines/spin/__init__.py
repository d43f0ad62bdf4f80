"""tasks/pipelines/spin."""
