from .cluster import available_cores, dask_client, lazy_client, start_early
from .launch import plan_lines, plan_span, run_with_prefect, run_without_prefect, start_server_early
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
    "start_early",
    "start_server_early",
]
