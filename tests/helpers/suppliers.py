"""Specimens of several suppliers, as the benchmark of partial pooling has them."""

from __future__ import annotations

from benchmarks.groups import EACH as EACH
from benchmarks.groups import NAMES as NAMES
from benchmarks.groups import exact as exact
from benchmarks.groups import hierarchy as hierarchy
from benchmarks.groups import labelled as labelled
from benchmarks.groups import measured as measured
