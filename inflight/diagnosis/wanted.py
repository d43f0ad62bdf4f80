"""What a person asks to be added: a name, a channel, or an entry of the model's file, made an addition."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from inflight.derived import base_channels, parse
from inflight.diagnosis.additions import DRIFTS, Addition, Maker, names_of
from inflight.diagnosis.lags import profile
from inflight.diagnosis.library import Candidate, Term, term_of
from inflight.diagnosis.refit import Column, Ground
from inflight.diagnosis.scoring import folds_of
from inflight.effects import known_effects
from inflight.effects.families import channels_of
from inflight.effects.naming import did_you_mean
from inflight.errors import ModelError
from inflight.geometry import GEOMETRY
from inflight.model import ModelEffect, make_effect
from inflight.model.timed import TimedValue
from inflight.sensors import sensors_of
from inflight.time import parse_duration, parse_utc, to_tt2000
from inflight.units import SECOND_NS

_LAG = re.compile(r"^(?P<mechanism>.+)@lag=(?P<lag>[^@]+)$")
_TIMED = re.compile(r"^(?P<kind>offset|bias|clock)_(?:step|episode)@(?P<at>[^/]+)(?:/(?P<end>.+))?$")
#: Names listed in a remedy at most.
_LISTED = 12
