"""The rule by which a design supports populations: what falls short, at which level."""

from typing import Any

import numpy as np
import pytest

from prbayes.model.coverage import (
    ENOUGH,
    TOLERABLE,
    VISIBLE,
    Requirement,
    Shortcoming,
    shortcoming,
    supports_each,
)


def support(ess: Any = 100.0, mass: Any = 1.0, lost: Any = 0.0) -> dict[str, Any]:
    values = np.broadcast_arrays(np.atleast_1d(ess), mass, lost, np.zeros(20))[:3]
    return dict(zip(("weight_ess", "mean_weight", "lost_mass"), values, strict=True))


def found(level: Requirement = ENOUGH, **keywords: Any) -> Shortcoming:
    return shortcoming(support(**keywords), 80.0, 0.05, 256, level)


def test_a_design_that_supports_all_falls_short_in_nothing() -> None:
    assert not found()
    assert str(found()) == ""


@pytest.mark.parametrize(
    ("keywords", "level", "which"),
    [
        ({"ess": 79.0}, ENOUGH, "ess"),
        ({"ess": 79.0}, TOLERABLE, None),
        ({"ess": 39.0}, TOLERABLE, "ess"),
        ({"mass": 0.79}, ENOUGH, "mass"),
        ({"mass": 1.26}, ENOUGH, "mass"),
        ({"mass": 1.26}, TOLERABLE, None),
        ({"mass": 0.69}, TOLERABLE, "mass"),
        ({"mass": 1.41}, TOLERABLE, "mass"),
        ({"lost": 0.06}, ENOUGH, "lost"),
        ({"lost": 0.04}, ENOUGH, None),
    ],
)
def test_levels(keywords: dict[str, float], level: Requirement, which: str | None) -> None:
    short = found(level, **keywords)
    assert bool(short) == (which is not None)
    for name in ("ess", "mass", "lost"):
        assert (getattr(short, name) is not None) == (name == which)


def test_single_populations_far_out_may_fall_short_and_a_tenth_may_not() -> None:
    ess = np.full(20, 100.0)
    ess[:1] = 90.0
    assert not found(ess=ess)
    ess[:3] = 7.0
    assert found(ess=ess).ess == (7.0, 100.0)
    mass = np.ones(20)
    mass[:3] = 0.5
    assert found(mass=mass)
    assert not found(TOLERABLE, mass=mass)


def test_lost_mass_is_said_first_and_alone() -> None:
    short = found(ess=1.0, lost=0.5)
    assert short.ess is not None
    assert str(short).startswith("lost mass: 50.0% of a population's weight")
    assert "effective" not in str(short)
    assert "expected 8 and 80, and mean raw weight from 3.00" in str(found(ess=1.0, mass=3.0))


def test_each_population_by_itself_is_supported_or_not() -> None:
    found = {
        "weight_ess": np.array([50.0, 9.0, 50.0, 50.0, 50.0, np.nan]),
        "mean_weight": np.array([1.0, 1.0, 0.4, 2.1, 1.0, 1.0]),
        "lost_mass": np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0]),
    }
    drawn = supports_each(found, 50.0, 0.05, VISIBLE)
    np.testing.assert_array_equal(drawn, [True, False, False, False, False, False])
    # A sum of weights that is zero, but for rounding, is none.
    found["lost_mass"] = np.full(6, 1e-16)
    assert supports_each(found, 50.0, 0.0, VISIBLE)[0]
