"""The problems, a file each."""

from __future__ import annotations

from benchmarks.scoreboard.problem import Problem
from benchmarks.scoreboard.problems import (
    contaminated,
    crack_growth,
    folded,
    frame,
    growth,
    linear,
    tension_304l,
    thermal,
    three_masses,
    virkler,
    wrong_family,
)

_ONE = (linear, folded, contaminated, wrong_family, crack_growth, thermal)
_SEVERAL = (frame, virkler, tension_304l, growth)
_ALL: tuple[Problem, ...] = (*(file.PROBLEM for file in _ONE + _SEVERAL), *three_masses.PROBLEMS)
PROBLEMS = {problem.name: problem for problem in _ALL}
