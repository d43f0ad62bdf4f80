"""A mission of one magnetometer that says all that the files of a release need."""

PROBE_YAML = """\
mission: probe
description: A probe with one magnetometer
acknowledgement: Thank you
instruments:
  fgm:
    role: vector
    cadence: 600 s
    files: {pattern: "a_{day:%Y%m%d}.cdf", reader: cdf, time: Epoch}
    channels: {field: {variable: B, unit: nT, axes: [x, y, z]}}
comparisons: {main: {kind: spin, vector: fgm}}
release:
  source_name: PROBE>A Probe
  project: Test>A test
  discipline: Space Physics>Magnetospheric Science
  pi_name: Someone
  pi_affiliation: Somewhere
  rules_of_use: Free
"""
