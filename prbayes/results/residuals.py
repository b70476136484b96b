"""Residuals of the readings of each specimen, with the names of population pharmacokinetics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import Tree, View
from prbayes._validate import (
    Floats,
    Indices,
    NamedArrays,
    Names,
    Seed,
    positive_integer,
    seed_number,
)
from prbayes.model.locking import locked
from prbayes.model.measurement import (
    Measurement,
    SpecimenLikelihood,
    output_columns,
    specimen_numbers,
    unit_readings,
)
from prbayes.model.specimen_likelihood import (
    draw_inputs,
    population_inputs,
    read_outputs,
    response_at,
)
from prbayes.model.specimen_preparation import with_more_points
from prbayes.optimize.optimum import Optimum
from prbayes.response.inputs import aleatory_names
from prbayes.results.individuals import individuals_of, is_log_normal
from prbayes.results.predict import populations_of


@locked
def residuals(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    n_draws: int = 1000,
    random_seed: Seed = 0,
) -> ResidualTable:
    r"""Compare the readings of each specimen with the population and with its own inputs.

    Inputs of specimen i in the population are :math:`\eta_i + \theta`, logarithms if they are
    lognormal, with covariance :math:`\Omega`. :math:`\hat\eta_i` is their mean given the readings,
    :math:`G_i` the Jacobian of the response there, and :math:`\Sigma_i` the covariance of the
    errors of the readings. Conditional weighted residuals are [1]_

    .. math:: \mathrm{CWRES}_i = C_i^{-1/2} \bigl(y_i - f(\hat\eta_i) + G_i \hat\eta_i\bigr),
        \qquad C_i = G_i \Omega G_i^T + \Sigma_i.

    They are close to independent standard normal numbers if the model is right. Of a posterior the
    moments are those of all its populations together.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from `sample` or any sampler of PyMC.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default. Its simulators have the
        log-likelihood by specimen.
    n_draws : int
        Number of populations, over all chains, and of draws of each specimen, at least 2.
    random_seed : int, sequence of int, numpy.random.Generator or None

    Returns
    -------
    xarray.DataTree
        A group for each simulator, with the names of nlmixr2 and dimensions (specimen, output):
        ``DV`` (readings), ``PRED`` (response at the mean inputs of the population), ``IPRED`` (at
        the mean inputs of the specimen), ``IWRES`` (residual of ``IPRED`` in standard deviations of
        the reading error; NaN for exact readings), ``CWRES``, and ``eta`` with dimensions
        (specimen, input). NaN where nothing was measured, or a reading is censored; ``CWRES`` of
        selected specimens are NaN.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the model has no simulator with the log-likelihood by
        specimen, or the result is of another model.

    References
    ----------
    .. [1] Hooker, A. C., C. E. Staatz and M. O. Karlsson (2007), Conditional weighted residuals
       (CWRES): a model diagnostic for the FOCE method, Pharm. Res. 24, 2187-2197,
       doi:10.1007/s11095-007-9361-x.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
    ...     data = [0.0, 1.0, 2.5, 4.0, 3.0, 1.5]
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=data)
    >>> table = prb.residuals(prb.minimize(model)).to_dataframe()
    >>> [str(name) for name in table.columns]
    ['simulator', 'specimen', 'DV', 'PRED', 'IPRED', 'IWRES', 'CWRES', 'eta_x']
    """
    positive_integer(n_draws, "n_draws", minimum=2)
    result, model, likelihoods = individuals_of(result, model, "prb.residuals")
    points, _ = populations_of(result, model, n_draws, "prb.residuals", copies=n_draws)
    rng = np.random.default_rng(None if random_seed is None else seed_number(random_seed))
    datasets = {}
    for likelihood in likelihoods:
        linear = _Linearisation.of(likelihood, points, rng)
        parts = [
            _read_beside_response(likelihood, m, linear, points, rng)
            for m in likelihood.measurements
        ]
        conditional = _conditional_residuals(linear, parts)
        for m, part, values in zip(likelihood.measurements, parts, conditional, strict=True):
            # The residuals of selected specimens are not normal with mean zero.
            is_whole_population = m.metric.selected is None
            values = values if is_whole_population else np.full_like(values, np.nan)
            datasets[m.name] = _labelled_residuals(m, part, values, linear)
    return ResidualTable.from_dict(datasets)


class ResidualTable(Tree):
    """ResidualTable of the readings of each specimen, a group for each simulator."""

    __slots__ = ()

    @property
    def _is_whole(self) -> bool:
        return bool(self.children) and all("CWRES" in tree for tree in self.children.values())

    def to_dataframe(self) -> Any:
        """Return a row for each reading, with the name of its simulator and the eta of inputs."""
        if not self._is_whole:
            return super().to_dataframe()
        import pandas as pd

        tables = []
        for name, tree in self.children.items():
            data = tree.to_dataset()
            columns = data.drop_vars(["eta", "input"]).to_dataframe().reset_index()
            columns.insert(0, "simulator", name)
            for label in data["input"].values:
                eta = data["eta"].sel(input=label).drop_vars("input")
                columns[f"eta_{label}"] = eta.broadcast_like(data["DV"]).values.ravel()
            tables.append(columns)
        table = pd.concat(tables, ignore_index=True)
        return table[table["DV"].notna()].reset_index(drop=True)

    def to_view(self) -> View:
        """Return what a reader sees."""
        rows = []
        sentences = ["A right model has CWRES with mean 0 and sd 1."]
        for name, tree in self.children.items():
            if np.isfinite(tree["DV"]).any() and not np.isfinite(tree["CWRES"]).any():
                sentences.append(f"{name} has no CWRES, as its specimens are selected.")
            for key in ("IWRES", "CWRES"):
                x = np.asarray(tree[key])
                x = x[np.isfinite(x)]
                numbers = (x.mean(), x.std(), np.abs(x).max()) if x.size else (np.nan,) * 3
                rows.append([f"{key} of {name}", f"{x.size}", *(f"{n:.3g}" for n in numbers)])
        header = ["", "readings", "mean", "sd", "largest"]
        return View("Residuals of the measured specimens", header, rows, sentences)


@dataclass(frozen=True)
class _Linearisation:
    """The response of S specimens near their own inputs, with d unconstrained inputs."""

    eta: Floats  # (S, d)
    names: list[str]  # of the d inputs
    population: Floats  # (S, M): response at the mean inputs of the population
    individual: Floats  # (S, M): response at the mean inputs of the specimen
    jacobian: Floats  # (S, M, d)
    covariance: Floats  # (S, d, d): of the inputs in the population

    @classmethod
    def of(
        cls, likelihood: SpecimenLikelihood, points: NamedArrays, rng: np.random.Generator
    ) -> _Linearisation:
        """Return the response linearised at the mean inputs of each specimen."""
        aleatory = likelihood.inputs.aleatory
        inputs, _ = draw_inputs(with_more_points(likelihood), rng, points)
        population = population_inputs(likelihood, points, np.arange(inputs[0].shape[1]), rng)
        unknown = [k for k in range(len(aleatory)) if k not in likelihood.inputs.conditions]
        is_log = [is_log_normal(x) for x in aleatory]
        shapes = [x.shape[2:] for x in inputs]

        def flat(values: list[Floats]) -> Floats:
            columns = []
            for k in unknown:
                column = np.log(values[k]) if is_log[k] else values[k]
                columns.append(column.reshape(*column.shape[:2], -1))
            return np.concatenate(columns, axis=-1)

        def responses(eta: Floats) -> Floats:
            values = [x[0] for x in inputs]
            begin = 0
            for k in unknown:
                end = begin + int(np.prod(shapes[k]))
                part = eta[:, begin:end].reshape(-1, *shapes[k])
                values[k] = np.exp(part) if is_log[k] else part
                begin = end
            outputs: Floats = response_at(likelihood, [x[None] for x in values])[0]
            return outputs

        drawn = flat(population)
        mean = flat(inputs).mean(axis=0)
        centre = drawn.mean(axis=0)
        deviations = drawn - centre
        products = np.einsum("psi,psj->sij", deviations, deviations)
        covariance = products / (len(drawn) - 1)
        # Steps of a hundredth of the population's standard deviation.
        steps = 0.01 * np.sqrt(np.einsum("sii->si", covariance))
        columns = []
        for j in range(steps.shape[1]):
            step = np.zeros_like(steps)
            step[:, j] = steps[:, j]
            above = responses(mean + step)
            below = responses(mean - step)
            width = 2 * steps[:, j : j + 1]
            columns.append((above - below) / width)
        labels = aleatory_names(likelihood.inputs, likelihood.measurements[0].responses.function)
        names = []
        for k in unknown:
            indices = list(np.ndindex(*shapes[k]))
            names += [
                labels[k] + (f"[{', '.join(map(str, index))}]" if index else "")
                for index in indices
            ]
        jacobian = np.stack(columns, axis=-1)
        individual = responses(mean)
        return cls(mean - centre, names, responses(centre), individual, jacobian, covariance)


@dataclass(frozen=True)
class _Compared:
    """Readings of one simulator beside the response, (n, m)."""

    specimens: Indices  # (n,): index of the specimen of each row
    observed: Floats  # NaN where nothing was measured, or a reading is censored
    population: Floats
    individual: Floats
    expected: Floats  # readings expected at the specimen's inputs: the response and a bias
    variance: Floats  # of the reading error
    jacobian: Floats  # (n, m, d)


def _read_beside_response(
    likelihood: SpecimenLikelihood,
    m: Measurement,
    linear: _Linearisation,
    points: NamedArrays,
    rng: np.random.Generator,
) -> _Compared:
    """Return the readings of one simulator beside the response."""
    numbers = specimen_numbers(likelihood, m)
    columns = output_columns(likelihood, m)
    of_rows = (linear.population, linear.individual, linear.jacobian)
    population, individual, jacobian = (x[numbers][:, columns] for x in of_rows)
    size = len(next(iter(points.values())))
    outputs = np.broadcast_to(individual, (size, *individual.shape))
    readings = unit_readings(m)
    replicates = read_outputs(rng, outputs, readings, (m,), points)
    observed = np.where(readings.is_censored, np.nan, m.rows)
    # The variance of equal numbers may differ from zero by rounding.
    is_exact = np.ptp(replicates, axis=0) == 0
    expected = np.where(is_exact, individual, replicates.mean(axis=0))
    variance = np.where(is_exact, 0.0, replicates.var(axis=0))
    return _Compared(numbers, observed, population, individual, expected, variance, jacobian)


def _conditional_residuals(linear: _Linearisation, parts: Sequence[_Compared]) -> list[Floats]:
    """Return the conditional weighted residuals of each simulator, (n, m).

    All readings of a specimen have a common covariance, also those of several simulators.
    """
    width = linear.eta.shape[1]
    numbers, jacobians, variances, differences = [], [], [], []
    for x in parts:
        n_outputs = x.observed.shape[1]
        numbers.append(np.repeat(x.specimens, n_outputs))
        jacobians.append(x.jacobian.reshape(-1, width))
        variances.append(x.variance.ravel())
        difference = x.observed - x.expected
        differences.append(difference.ravel())
    specimens = np.concatenate(numbers)
    jacobian = np.concatenate(jacobians)
    variance = np.concatenate(variances)
    # The response at the mean inputs of the population, by the linear response.
    shift = np.einsum("rd,rd->r", jacobian, linear.eta[specimens])
    residual = np.concatenate(differences) + shift
    result = np.full(residual.shape, np.nan)
    is_read = np.isfinite(residual)
    for s in np.unique(specimens[is_read]):
        rows = np.flatnonzero(is_read & (specimens == s))
        slopes = jacobian[rows]
        of_inputs = slopes @ linear.covariance[s] @ slopes.T
        of_errors = np.diag(variance[rows])
        result[rows] = _whitened(residual[rows], of_inputs + of_errors)
    ends = np.cumsum([x.observed.size for x in parts])
    split = np.split(result, ends[:-1])
    return [values.reshape(x.observed.shape) for values, x in zip(split, parts, strict=True)]


def _labelled_residuals(
    m: Measurement, part: _Compared, conditional: Floats, linear: _Linearisation
) -> xr.Dataset:
    """Return the residuals of one simulator with labels of specimens and outputs."""
    labels = np.arange(len(m.observed)) if m.specimens is None else np.asarray(m.specimens)
    coords: dict[str, Any] = {"specimen": labels, "input": linear.names}
    dims: Names = ("specimen",)
    if m.event:
        dims = ("specimen", m.outputs.dim)
        coords[m.outputs.dim] = list(m.outputs.labels)
    residual, sd = part.observed - part.expected, np.sqrt(part.variance)
    individual = np.full(sd.shape, np.nan)
    np.divide(residual, sd, out=individual, where=sd > 0)
    arrays = {
        "DV": part.observed,
        "PRED": part.population,
        "IPRED": part.individual,
        "IWRES": individual,
        "CWRES": conditional,
    }
    is_missing = np.isnan(part.observed)
    data: dict[str, Any] = {}
    for name, values in arrays.items():
        read = np.where(is_missing, np.nan, values)
        data[name] = (dims, read.reshape(m.observed.shape))
    data["eta"] = (("specimen", "input"), linear.eta[part.specimens])
    return xr.Dataset(data, coords)


def _whitened(residual: Floats, covariance: Floats) -> Floats:
    """Return the residual times the inverse symmetric square root of its covariance."""
    eigenvalues, vectors = np.linalg.eigh(covariance)
    # Exact readings of fewer inputs than readings have no density in some directions.
    is_regular = eigenvalues > 1e-10 * eigenvalues[-1]
    scaled = np.divide(
        vectors.T @ residual,
        np.sqrt(np.abs(eigenvalues)),
        out=np.zeros_like(residual),
        where=is_regular,
    )
    return np.asarray(vectors @ scaled)
