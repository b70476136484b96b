"""ArviZ's own plots take our trees."""

import inspect
import re
from functools import cache
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import pytest
import xarray as xr
from one_input import one_input

import prbayes as prb


@cache
def checked() -> xr.DataTree:
    """A posterior with predictive draws of as many specimens as were measured."""
    observed = np.random.default_rng(2).normal(1, 0.5, 40)
    model = one_input(observed, prb.AreaMetric(), mu=(1, 1))
    return prb.sample_smc(60, chains=2, random_seed=1, model=model, progressbar=False)


@pytest.mark.long
@pytest.mark.parametrize("plot", ["plot_ppc_dist", "plot_ppc_tstat", "plot_ppc_pit"])
def test_predictive_checks_take_our_trees(plot: str, tmp_path: Path) -> None:
    pc = getattr(az, plot)(checked(), backend="matplotlib")
    pc.savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000


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


REFUSED = ["loo", "loo_pit", "loo_expectations", "loo_metrics", "loo_influence"]
REFUSED += ["plot_loo_interval", "plot_loo_pit", "plot_energy", "bfmi"]


@pytest.mark.long
@pytest.mark.parametrize("name", REFUSED)
def test_what_the_table_says_is_refused_gives_no_number(name: str) -> None:
    assert TOLD[name].startswith("refused")
    with pytest.raises((TypeError, KeyError, ValueError)):
        getattr(az, name)(checked())
