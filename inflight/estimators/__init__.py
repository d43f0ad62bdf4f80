"""Estimators: what a whole mission of residuals and daily parameters tells, each with its uncertainty.

Pure functions of arrays, Datasets and normal equations. Each returns a frozen result with `table()`:
an `xarray.Dataset` of `value`, `sigma` and `units`.
"""
