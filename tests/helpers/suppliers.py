"""Specimens of several suppliers, as the benchmark of partial pooling has them."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.groups import EACH as EACH
from benchmarks.groups import NAMES as NAMES
from benchmarks.groups import exact as exact
from benchmarks.groups import hierarchy as hierarchy
from benchmarks.groups import labelled as labelled
from benchmarks.groups import measured as measured
