"""Flows: the steps of `inflight.tasks` in order, run plainly or with Prefect; they hold no numerics.

In go a workspace and the parameters of a flow by its name (`ingest`, `reprocess`, `backfill`, `monthly`,
`diagnose`, `update`, `release`); out comes a `RunReport`. Open `steps` first: each flow is written there
once. `runner` runs its batches on Dask processes (`cluster`), with or without Prefect tasks; `launch` starts
a flow from the command line, and deployments name those of `prefect_flows`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
