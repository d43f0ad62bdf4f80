from .cluster import available_cores, client_when_needed, dask_client
from .launch import run_embedded, run_plain
from .plan import plan_span
from .span import Span

__all__ = [
    "Span",
    "available_cores",
    "client_when_needed",
    "dask_client",
    "plan_span",
    "run_embedded",
    "run_plain",
]
