"""Expected standard deviations beside those of normal populations."""

import numpy as np
import pytest
import xarray as xr
from decisions import N, normal, optimum, same

import prbayes as prb


@pytest.fixture(scope="module")
def table() -> xr.Dataset:
    _, x = normal()
    quantity = prb.decision.Quantile(same, x, probability=0.95)
    candidates = {
        "same": prb.decision.Condition(same, x),
        "size": prb.decision.Condition(
            lambda x: np.abs(x - 1.0), x, metric=prb.LogLikelihood(density=prb.GaussianKDE())
        ),
    }
    return prb.plan(optimum(), candidates, k=[N, 3 * N], quantity=quantity)


def test_specimens_of_the_same_kind_narrow_by_their_number(table: xr.Dataset) -> None:
    ratio = table.sd.sel(candidate="same") / table.now
    np.testing.assert_allclose(ratio.sel(k=N), np.sqrt(1 / 2), rtol=0.05)
    np.testing.assert_allclose(ratio.sel(k=3 * N), np.sqrt(1 / 4), rtol=0.06)
    assert table.now.sel(name="mu") == pytest.approx(optimum().stderr["mu"], rel=0.03)


def test_another_condition_tells_of_what_it_sees(table: xr.Dataset) -> None:
    ratio = (table.sd / table.now).sel(candidate="size", k=3 * N)
    assert float(ratio.sel(name="mu")) > 0.9
    assert float(ratio.sel(name="sigma")) < 0.6


@pytest.mark.slow
def test_the_number_that_reaches_a_target() -> None:
    _, x = normal()
    condition = {"same": prb.decision.Condition(same, x)}
    target = {"mu": 0.03, "quantity": 1e-9, "sigma": 9.0}
    quantity = prb.decision.Quantile(same, x, probability=0.95)
    table = prb.plan(optimum(), condition, k=5, quantity=quantity, target=target)
    needed = table.specimens.sel(candidate="same")
    now = float(table.now.sel(name="mu"))
    assert float(needed.sel(name="mu")) == pytest.approx(N * ((now / 0.03) ** 2 - 1), rel=0.1)
    assert float(needed.sel(name="sigma")) == 0
    assert float(needed.sel(name="quantity")) == np.inf
    # It is the least.
    k = int(needed.sel(name="mu"))
    around = prb.plan(optimum(), condition, k=[k - 1, k]).sd.sel(candidate="same", name="mu")
    assert float(around[1]) <= 0.03 < float(around[0])


def test_a_target_that_is_in_no_table_is_refused() -> None:
    condition = {"same": prb.decision.Condition(same, normal()[1])}
    with pytest.raises(KeyError, match=r"got 'quantity', expected one of \['mu', 'sigma'\]"):
        prb.plan(optimum(), condition, k=5, target={"quantity": 1.0})
