"""What `sample_smc` returns, as PyMC's keywords ask for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._validate import called, flag
from prbayes.model.evaluator import Evaluator

# Those of `pymc.to_inference_data` that say something here.
_IDATA = ("coords", "dims", "log_likelihood", "log_prior")
# Groups that have variables of the model.
_OF_VARIABLES = ("posterior", "prior", "log_prior")


def checked_names(var_names: object, model: pm.Model) -> list[str] | None:
    """Return names of variables and deterministics of a model, or raise; None for all.

    Raises
    ------
    KeyError, TypeError
    """
    if var_names is None:
        return None
    names = [var_names] if isinstance(var_names, str) else var_names
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"var_names: got {called(var_names)}, expected names of variables")
    known = [str(variable.name) for variable in model.unobserved_RVs]
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise KeyError(f"var_names: got {unknown or 'none'}, expected some of {known}")
    return list(names)


def checked_idata_kwargs(idata_kwargs: object) -> dict[str, Any]:
    """Return keywords of `pymc.to_inference_data`, or raise.

    Raises
    ------
    TypeError
    """
    if idata_kwargs is None:
        return {}
    if not isinstance(idata_kwargs, Mapping):
        raise TypeError(f"idata_kwargs: got {called(idata_kwargs)}, expected a dict")
    unknown = sorted(map(str, set(idata_kwargs) - set(_IDATA)))
    if unknown:
        raise TypeError(
            f"idata_kwargs: got {unknown}, expected some of {list(_IDATA)}; priors and predictive "
            "draws are in the result, transformed values in calibration.theta"
        )
    for name in ("log_likelihood", "log_prior"):
        flag(idata_kwargs.get(name, True), f"idata_kwargs: {name}")
    for name in ("coords", "dims"):
        if not isinstance(idata_kwargs.get(name, {}), Mapping):
            raise TypeError(
                f"idata_kwargs: {name}: got {called(idata_kwargs[name])}, expected a dict"
            )
    return dict(idata_kwargs)


def as_asked(
    tree: xr.DataTree, var_names: Sequence[str] | None, idata_kwargs: Mapping[str, Any]
) -> xr.DataTree:
    """Return a result with some variables only, and other names of dimensions and coordinates."""
    groups = {}
    for name, node in tree.children.items():
        if not idata_kwargs.get(name, True):
            continue
        group = node.to_dataset()
        if var_names is not None and name in _OF_VARIABLES:
            group = group[[one for one in group.data_vars if one in var_names]]
        group = _with_dims(group, idata_kwargs.get("dims", {}))
        coords = idata_kwargs.get("coords", {})
        groups[name] = group.assign_coords(
            {dim: values for dim, values in coords.items() if dim in group.dims}
        )
    return xr.DataTree.from_dict(groups)


def _with_dims(group: xr.Dataset, dims: Mapping[str, Any]) -> xr.Dataset:
    """Return a group whose variables have other dimensions behind chain and draw."""
    for name, given in dims.items():
        if name not in group:
            continue
        names = [given] if isinstance(given, str) else list(given)
        before = [dim for dim in group[name].dims if dim not in ("chain", "draw")]
        if len(before) != len(names):
            raise ValueError(
                f"idata_kwargs: dims: {name}: got {names}, expected {len(before)} names, one for "
                "each dimension"
            )
        renamed = group[name].rename(dict(zip(before, names, strict=True)))
        group = group.drop_vars(name).assign({name: renamed})
    return group


def as_multitrace(tree: xr.DataTree, evaluator: Evaluator) -> Any:
    """Return the draws as a `pymc.backends.base.MultiTrace`, without what else is known of them."""
    from pymc.backends.base import MultiTrace
    from pymc.backends.ndarray import NDArray

    sizes = [int(np.prod(shape, dtype=int)) for shape in evaluator.hyperparameters.shapes.values()]
    ends = np.cumsum(sizes)[:-1]
    chains = []
    of_all = np.asarray(tree["calibration"]["theta"])
    for chain, thetas in enumerate(of_all):
        held = NDArray(model=evaluator.model)
        held.setup(len(thetas), chain)
        for theta in thetas:
            pairs = zip(
                evaluator.hyperparameters.shapes.items(), np.split(theta, ends), strict=True
            )
            point = {name: part.reshape(shape) for (name, shape), part in pairs}
            held.record(point, in_warmup=False)
        chains.append(held)
    return MultiTrace(chains)
