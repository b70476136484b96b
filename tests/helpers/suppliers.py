"""Specimens of several suppliers, as the benchmark of partial pooling has them."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.suppliers import EACH as EACH
from benchmarks.suppliers import NAMES as NAMES
from benchmarks.suppliers import exact as exact
from benchmarks.suppliers import hierarchy as hierarchy
from benchmarks.suppliers import labelled as labelled
from benchmarks.suppliers import measured as measured
