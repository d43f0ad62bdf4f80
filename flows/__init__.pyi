from .cluster import available_cores, dask_client, lazy_client
from .launch import plan_lines, plan_span, run_with_prefect, run_without_prefect
from .schedule import ScheduledFlow, scheduled_flows
from .span import DaySpan

__all__ = [
    "DaySpan",
    "ScheduledFlow",
    "available_cores",
    "dask_client",
    "lazy_client",
    "plan_lines",
    "plan_span",
    "run_with_prefect",
    "run_without_prefect",
    "scheduled_flows",
]
