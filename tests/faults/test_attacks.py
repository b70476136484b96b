"""Attacks on what is on disk: it is found again bit by bit, or refused with a sentence."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from benchmarks.attacks import ATTACKS, allowed


@pytest.mark.long
@pytest.mark.parametrize("name", ATTACKS)
def test_a_few_of_each_attack_are_survived(name: str, tmp_path: Path) -> None:
    attack, n = ATTACKS[name]
    found = Counter(attack(tmp_path, np.random.default_rng(3), n))
    assert found.total() == n
    assert set(found) <= allowed(name)
