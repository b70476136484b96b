"""Results with one posterior: a product of a fleet with its own data, or chains of a result."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from pymc.model.fgraph import clone_model

# Groups of ArviZ whose variables all have the dimensions chain and draw.
_BY_DRAW = {"posterior", "posterior_predictive", "sample_stats", "log_likelihood"}


def one_posterior(result: Any, caller: str) -> Any:
    """Return a result whose posterior has the dimensions chain and draw; raise for a fleet.

    Of a product, the data that are padded to the largest number of specimens lose these rows.
    """
    if product_names(result) and "product" in result["posterior"].dims:
        first, *more = product_names(result)
        raise ValueError(
            f"{caller}: got posteriors of {len(more) + 1} products, expected one; pass "
            f"fleet.sel(product={first!r}), and for all products call this for each name of "
            "fleet['products']['product'].values"
        )
    result = with_chains(result)
    if isinstance(result, xr.DataTree) and "posterior" in result.children:
        lacking = {"chain", "draw"} - set(result["posterior"].dims)
        if lacking:
            raise ValueError(
                f"{caller}: got a posterior without the dimensions {sorted(lacking)}, expected "
                "draws, as of prb.sample; pass the result itself, not means of its draws"
            )
    if product_names(result) and "observed_data" in result.children:
        data = result["observed_data"].to_dataset()
        for dim in data.dims:
            data = data.dropna(dim, how="all")
        result = result.copy()
        result["observed_data"] = xr.DataTree(data)
    return result


def with_chains(result: Any) -> Any:
    """Restore the dimensions chain and draw, which a selection of one of them has lost."""
    if not isinstance(result, xr.DataTree) or "posterior" not in result.children:
        return result
    posterior = result["posterior"]
    lost = [
        dim for dim in ("chain", "draw") if dim in posterior.coords and dim not in posterior.dims
    ]
    if "draw" in posterior.dims and not {"chain"} & {*posterior.coords, *posterior.dims}:
        lost.append("chain")
    if not lost:
        return result
    groups = {name: node.to_dataset() for name, node in result.children.items()}
    for name in _BY_DRAW & set(groups):
        present = [dim for dim in lost if name == "posterior" or dim in groups[name].coords]
        groups[name] = groups[name].expand_dims(present)
    return type(result).from_dict(groups)


def product_names(result: Any) -> list[str]:
    """Return the names of the products of a fleet, or of one of them; none for other results."""
    is_of_fleet = isinstance(result, xr.DataTree) and "products" in result.children
    return list(map(str, np.ravel(result["products"]["product"]))) if is_of_fleet else []


def model_of_product(result: Any, model: pm.Model) -> pm.Model:
    """Return the model with the data of a product; the model itself for other results."""
    if not product_names(result) or "observed_data" not in result.children:
        return model
    copy = clone_model(model)
    for name, values in result["observed_data"].data_vars.items():
        variable = copy[str(name)]
        observed = pt.constant(np.asarray(values, dtype=np.float64))
        del copy.values_to_rvs[copy.rvs_to_values[variable]]
        copy.rvs_to_values[variable] = observed
        copy.values_to_rvs[observed] = variable
    return copy
