"""ArviZ's own plots take our trees."""

import inspect
import re
from functools import cache
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.validation.pit import area


@cache
def checked() -> xr.DataTree:
    """A posterior with predictive draws of as many specimens as were measured."""
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        observed = np.random.default_rng(2).normal(1, 0.5, 40)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=observed)
        idata = prb.sample_smc(60, chains=2, random_seed=1, progressbar=False)
    return idata


@pytest.mark.long
@pytest.mark.parametrize(
    ("plot", "keywords"),
    [
        ("plot_ppc_dist", {}),
        ("plot_ppc_dist", {"kind": "ecdf"}),
        ("plot_ppc_tstat", {"t_stat": "std"}),
        ("plot_ppc_pit", {}),
    ],
)
def test_predictive_checks_take_our_trees(
    plot: str, keywords: dict[str, Any], tmp_path: Path
) -> None:
    pc = getattr(az, plot)(checked(), backend="matplotlib", **keywords)
    pc.savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_predictions_of_unequal_size_give_u_values_that_arviz_draws(tmp_path: Path) -> None:
    """20 measured and 100 000 predicted responses: ArviZ's own test takes our u-values."""
    rng = np.random.default_rng(1)
    predicted = rng.normal(rng.normal(0, 0.25, (200, 1)), 1.0, (200, 500))
    test = prb.area_test(rng.normal(0, 1, 20), predicted, null=prb.validation.PosteriorNull(99))
    tree = xr.DataTree.from_dict({"posterior": xr.Dataset({"u": ("observation", test.u_values)})})
    pc = az.plot_ecdf_pit(tree, group="posterior", sample_dims="observation", backend="matplotlib")
    pc.savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000
    assert area(test.u_values) == test.statistic


ROWS = dict(
    re.findall(
        r"^\| ([a-z_0-9 ]+) \| (.+) \|$",
        (Path(__file__).parents[2] / "docs" / "pymc_and_arviz.md")
        .read_text(encoding="utf-8")
        .split("## ArviZ")[1],
        re.MULTILINE,
    )
)
TOLD = {name: told for names, told in ROWS.items() for name in names.split()}
MORE: dict[str, Any] = {
    "plot_bf": {"var_names": "mu", "ref_val": 1.0},
    "bayes_factor": {"var_names": "mu", "ref_vals": 1.0},
    "plot_pair_focus": {"focus_var": "mu"},
    "rhat_nested": {"superchain_ids": [0, 1]},
    "ci_in_rope": {"rope": (1, 2)},
}


def test_the_table_has_every_function_of_arviz() -> None:
    own = {name for name in vars(az) if not name.startswith("_")}
    functions = {name for name in own if inspect.isroutine(getattr(az, name))}
    assert functions <= set(TOLD)
    assert set(TOLD) - {"functions", "of"} <= own


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:No 'constant_data' group:UserWarning")
@pytest.mark.parametrize("name", [name for name, told in TOLD.items() if told.startswith("work")])
def test_what_the_table_says_works_does(name: str) -> None:
    if name == "combine_plots":
        assert az.combine_plots(checked(), [(az.plot_trace, {}), (az.plot_rank, {})])
        return
    assert getattr(az, name)(checked(), **MORE.get(name, {})) is not None


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    [
        "loo",
        "loo_pit",
        "loo_expectations",
        "loo_metrics",
        "loo_influence",
        "plot_loo_interval",
        "plot_loo_pit",
        "plot_energy",
        "bfmi",
    ],
)
def test_what_the_table_says_is_refused_gives_no_number(name: str) -> None:
    assert TOLD[name].startswith("refused")
    with pytest.raises((TypeError, KeyError, ValueError)):
        getattr(az, name)(checked())
