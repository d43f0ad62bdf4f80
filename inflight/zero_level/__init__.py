"""Zero levels of a magnetometer from nature's own statistics: Alfvenic rotations, compressions, flippers.

No file is opened here; every method takes `Intervals` and returns an `Estimate`.
"""
