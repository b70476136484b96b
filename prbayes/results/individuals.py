"""Inputs of the measured specimens themselves, with replicates of their readings."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import Tree, View
from prbayes._finding import report
from prbayes._stats import INTERVAL
from prbayes._validate import Floats, NamedArrays, Seed, positive_integer, seed_number
from prbayes.model.locking import locked
from prbayes.model.measurement import SpecimenLikelihood, specimen_labels
from prbayes.model.parameters import element_name
from prbayes.model.specimen_likelihood import draw_inputs, draw_readings, specimen_likelihoods
from prbayes.model.specimen_preparation import with_more_points
from prbayes.optimize.optimum import Optimum
from prbayes.response.inputs import aleatory_names
from prbayes.response.outputs import Outputs
from prbayes.results.predict import model_of, populations_of
from prbayes.results.products import (
    ProductResults,
    each_product,
    findings_together,
    model_of_product,
    one_posterior,
)


@locked
@each_product
def individuals(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    n_draws: int = 400,
    random_seed: Seed = 0,
) -> Individuals:
    r"""Draw the inputs of each measured specimen, given its readings and the population.

    Readings of a specimen that say little about an input leave it near the population's mean. The
    shrinkage of an input is

    .. math:: 1 - \frac{\operatorname{sd}_i\, E[x_i \mid y_i, \theta]}{\sigma(\theta)},

    with the standard deviation of the means over the specimens, and that of the population, of the
    logarithm of a lognormal input: near zero where readings identify the input, near one where they
    do not [1]_.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from `sample` or any sampler of PyMC. The
        population of an optimum is taken as known: intervals are those of empirical Bayes. Of a
        fleet from `calibrate_each` the result has the dimension product.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default. Its simulators have the
        log-likelihood by specimen: metrics of distributions keep no record of a specimen.
    n_draws : int
        Number of populations, over all chains; the posterior's draws are thinned evenly.
    random_seed : int, sequence of int, numpy.random.Generator or None

    Returns
    -------
    xarray.DataTree
        Groups of ArviZ: ``posterior`` has each input with dims (chain, draw, specimen), in its own
        units, with the attribute ``shrinkage``, and ``gross_error``, the probability of one, where
        the model has gross errors; ``posterior_predictive`` has replicates of the readings of each
        specimen, of another specimen under the same condition, and ``observed_data`` the readings.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the model has no simulator with the log-likelihood by
        specimen, or the result is of another model.

    References
    ----------
    .. [1] Savic, R. M., and M. O. Karlsson (2009), Importance of shrinkage in empirical Bayes
       estimates for diagnostics, AAPS J. 11, 558-569, doi:10.1208/s12248-009-9133-0.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
    ...     data = [0.0, 1.0, 2.5, 4.0, 3.0, 1.5]
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=data)
    >>> tree = prb.individuals(prb.minimize(model))
    >>> tree["posterior"]["x"].mean(("chain", "draw")).values.round(2) + 0
    array([0.  , 0.5 , 1.25, 2.  , 1.5 , 0.75])
    """
    positive_integer(n_draws, "n_draws")
    result, model, likelihoods = individuals_of(result, model, "prb.individuals")
    points, coords = populations_of(result, model, n_draws, "prb.individuals", copies=n_draws)
    seed = None if random_seed is None else seed_number(random_seed)
    rng = np.random.default_rng(seed)
    names = ("posterior", "posterior_predictive", "observed_data", "constant_data")
    groups: dict[str, dict[str, xr.DataArray]] = {name: {} for name in names}
    for likelihood in likelihoods:
        suffix = "" if len(likelihoods) == 1 else f" of {likelihood.name}"
        labels = specimen_labels(likelihood)
        if labels is None:  # The rows of a single simulator, in their order
            labels = likelihood.measurements[0].specimens
        size = len(likelihood.readings)
        specimens = {f"specimen{suffix}": np.arange(size) if labels is None else labels}
        inputs, gross_error = draw_inputs(with_more_points(likelihood), rng, points)
        input_names = aleatory_names(
            likelihood.inputs, likelihood.measurements[0].responses.function
        )
        columns = likelihood.stacked.conditions  # values of the specimens, (S, C), or None
        conditions = {}
        if columns is not None:
            conditions = dict(zip(likelihood.inputs.conditions, columns.T, strict=True))
        population = _population(likelihood, points, rng)
        for position, (name, values) in enumerate(zip(input_names, inputs, strict=True)):
            if position in conditions:
                array = xr.DataArray(conditions[position], specimens, tuple(specimens))
                groups["constant_data"][name + suffix] = array
                continue
            is_log = is_log_normal(likelihood.inputs.aleatory[position])
            shrinkage = _shrinkage(values, population[position], is_log=is_log)
            array = _array(name, values, coords | specimens)
            groups["posterior"][name + suffix] = array.assign_attrs(shrinkage=shrinkage.tolist())
        if gross_error is not None:
            name = "gross_error"
            groups["posterior"][name + suffix] = _array(name, gross_error, coords | specimens)
        for m in likelihood.measurements:
            rows = specimens
            if len(m.observed) != size:
                rows = {f"specimen of {m.name}": np.asarray(m.specimens)}
            replicates = draw_readings(likelihood, rng, points, len(m.observed), m)
            array = _array(m.name, replicates, coords | rows, m.outputs)
            groups["posterior_predictive"][m.name] = array
            observed = array.isel(chain=0, draw=0, drop=True).copy(data=m.observed)
            groups["observed_data"][m.name] = observed
    datasets = {name: xr.Dataset(arrays) for name, arrays in groups.items() if arrays}
    return Individuals.from_dict(datasets)


def individuals_of(
    result: Optimum | xr.DataTree, model: pm.Model | None, caller: str
) -> tuple[Optimum | xr.DataTree, pm.Model, list[SpecimenLikelihood]]:
    """Return a result, its model, and the likelihoods that have a record of each specimen."""
    result = one_posterior(result, caller)
    model = model_of_product(result, model_of(result, model, caller))
    likelihoods = dict.fromkeys(specimen_likelihoods(model).values())
    if not likelihoods:
        raise TypeError(
            f"{caller}: got a model whose metrics compare distributions, expected a "
            "prb.Simulator with metric=prb.LogLikelihood(), which has a record of each specimen"
        )
    return result, model, list(likelihoods)


class Individuals(Tree):
    """Draws of the inputs of each measured specimen."""

    __slots__ = ()
    _parts = ("posterior", "posterior_predictive", "observed_data")

    @classmethod
    def of_products(cls, parts: ProductResults[Self]) -> Self:
        """Return the individuals of products as one with the dimension ``product``.

        Specimens that a product lacks are NaN. The group ``shrinkage`` has that of each input.
        """
        report(*findings_together(parts.findings(lambda _: ())))
        products = xr.DataArray(list(parts.results), dims="product", name="product")
        datasets = {
            name: xr.concat(
                [tree[name].to_dataset() for tree in parts.results.values()],
                products,
                data_vars="all",
                coords="minimal",
                compat="override",
                join="outer",
                combine_attrs="drop_conflicts",
            )
            for name in parts.first.children
        }
        shrinkage = {}
        for key, x in parts.first["posterior"].data_vars.items():
            if "shrinkage" in x.attrs:
                dims = ("product", *(str(dim) for dim in x.dims[3:]))
                trees = [tree["posterior"].to_dataset() for tree in parts.results.values()]
                shrinkage[str(key)] = (dims, [tree[key].attrs["shrinkage"] for tree in trees])
        datasets["shrinkage"] = xr.Dataset(shrinkage, {"product": products})
        return cls.from_dict(datasets)

    def to_dataframe(self) -> Any:
        """Return mean, sd and 89 % interval of each input of each specimen, a row for each."""
        if not self._is_whole:
            return super().to_dataframe()
        import pandas as pd

        tables = []
        for name, draws in self["posterior"].data_vars.items():
            over = ("chain", "draw")
            columns = {"mean": draws.mean(over), "sd": draws.std(over)}
            for key, level in (("lower", (1 - INTERVAL) / 2), ("upper", (1 + INTERVAL) / 2)):
                columns[key] = draws.quantile(level, over, skipna=False).drop_vars("quantile")
            numbers = xr.Dataset(columns)
            dims = sorted(map(str, numbers.sizes), key=lambda dim: dim != "product")
            table = numbers.to_dataframe(dims).reset_index()
            table.insert(0, "input", str(name))
            tables.append(table)
        table = pd.concat(tables, ignore_index=True)
        # Of a fleet, rows without numbers are specimens that a product lacks.
        return table.dropna(subset="mean") if "shrinkage" in self.children else table

    def to_view(self) -> View:
        """Return what a reader sees."""
        numbers = ["mean", "sd", "lower", "upper"]
        table = self.to_dataframe()
        indices = table.drop(columns=[*numbers, "input"]).itertuples(index=False, name=None)
        rows = []
        for name, index, values in zip(
            table["input"], indices, table[numbers].to_numpy(), strict=True
        ):
            # NaN marks a dimension that the input lacks.
            labels = [str(i) for i in index if i == i]
            mean, sd, lower, upper = (f"{x:.4g}" for x in values)
            rows.append([element_name(name, labels), mean, sd, f"{lower} to {upper}"])
        sentences = [
            f"{name}: shrinkage {np.array2string(np.asarray(x.attrs['shrinkage']), precision=2)}."
            for name, x in self["posterior"].data_vars.items()
            if "shrinkage" in x.attrs
        ]
        if "shrinkage" in self.children:
            of_inputs = self["shrinkage"].data_vars.items()
            sentences = [f"{k}: shrinkage {x.min():.2f} to {x.max():.2f}." for k, x in of_inputs]
        header = ["", "mean", "sd", f"{INTERVAL:.0%} interval"]
        return View("Inputs of the measured specimens", header, rows, sentences)


def is_log_normal(x: Any) -> bool:
    """Return whether the shrinkage and the eta of an input are those of its logarithm."""
    return isinstance(x.owner.op, type(pm.LogNormal.rv_op))


def _shrinkage(values: Floats, population: Floats, *, is_log: bool) -> Floats:
    """Return one minus the spread of the specimens' means over that of the population, (*event)."""
    scale = np.log if is_log else np.positive
    within = scale(population).std(axis=1).mean(axis=0)
    return np.asarray(1 - scale(values).mean(axis=0).std(axis=0) / within)


def _population(
    likelihood: SpecimenLikelihood, points: NamedArrays, rng: np.random.Generator
) -> list[Floats]:
    """Return 256 specimens of each group from each population, by input, (P, n, *event)."""
    parts = []
    for group, rows in likelihood.by_group:
        parents = likelihood.parents(points, group, rows)
        drawn, _ = likelihood.density.sampler(parents, 256, rng)
        parts.append(drawn)
    return [np.concatenate(values, axis=1) for values in zip(*parts, strict=True)]


def _array(
    name: str, values: Floats, coords: dict[str, Any], outputs: Outputs | None = None
) -> xr.DataArray:
    """Label draws, (P, n, *event), by chain, draw, specimen, and outputs or elements."""
    event = values.shape[2:]
    event_dims = [f"{name}_dim_{i}" for i in range(len(event))]
    if outputs is not None and outputs.labels and event:
        event_dims = [outputs.dim]
        coords = coords | {outputs.dim: list(outputs.labels)}
    dims = ("chain", "draw", *[dim for dim in coords if dim not in ("chain", "draw", *event_dims)])
    sizes = (len(coords["chain"]), len(coords["draw"]), *values.shape[1:])
    return xr.DataArray(values.reshape(sizes), coords, (*dims, *event_dims), name=name)
