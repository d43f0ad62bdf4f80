"""tasks/pipelines/mission."""
