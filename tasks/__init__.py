"""Pipeline steps: each reads from the catalog, calls the physics and stages its result."""
