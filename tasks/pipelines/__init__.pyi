from .compare_rows import Sources, Spans, blocks_of, published_products, rows_of_day, scalar_channels
from .compared import Compared
from .job import Job, Outcome, make_days
from .planning import ReprocessSettings, equations_of, plan, product_of
from .publication import adopted_days, take_outcome
from .published_tables import table_sections
from .reprocessing import Mapper, reprocess
from .tables import load_equations, span_solution

__all__ = [
    "Compared",
    "Job",
    "Mapper",
    "Outcome",
    "ReprocessSettings",
    "Sources",
    "Spans",
    "adopted_days",
    "blocks_of",
    "equations_of",
    "load_equations",
    "make_days",
    "plan",
    "product_of",
    "published_products",
    "reprocess",
    "rows_of_day",
    "scalar_channels",
    "span_solution",
    "table_sections",
    "take_outcome",
]
