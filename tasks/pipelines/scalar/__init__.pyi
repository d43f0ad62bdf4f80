from .calibrate import EQUATIONS_VERSION, calibrate_batch, fit_day
from .compare_page import CompareReport, Drawn, Spectra, compare_parts, fails_text, page_title, wandering_text

__all__ = [
    "EQUATIONS_VERSION",
    "CompareReport",
    "Drawn",
    "Spectra",
    "calibrate_batch",
    "compare_parts",
    "fails_text",
    "fit_day",
    "page_title",
    "wandering_text",
]
