"""Maximum-likelihood estimates of other data sets, by the log-likelihood by specimen.

A data set is either the observed specimens with other weights, or specimens of a pool: simulated
specimens whose points are computed once. Both cost no run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.model.evaluator import Evaluator, specimen_graphs, specimen_params
from prbayes.model.measurement import SpecimenLikelihood, specimen_numbers
from prbayes.model.specimen_likelihood import arrays, draw_readings
from prbayes.model.specimen_preparation import prepared
from prbayes.optimize.optimum import Optimum, require_minimiser, require_sampling
from prbayes.propagation.specimen_emulation import specimen_roots
from prbayes.propagation.specimen_points import draw_points
from prbayes.response.compile import compiled, ninf_for_invalid, untraced


def specimen_refit_obstacle(evaluator: Evaluator) -> str | None:
    """Return why a model of log-likelihoods by specimen cannot be fitted to other data, or None."""
    others = len(evaluator.model.observed_RVs) > len(evaluator.measurements)
    if evaluator.nodes or others or evaluator.model.potentials:
        return (
            "the model has likelihood terms or potentials besides its log-likelihoods by specimen"
        )
    return None


def simulation_obstacle(evaluator: Evaluator) -> str | None:
    """Return why data sets cannot be simulated from a model, or None."""
    obstacle = specimen_refit_obstacle(evaluator)
    if obstacle is not None:
        return obstacle
    for likelihood in evaluator.likelihoods:
        if likelihood.readings.is_censored.any():
            return f"{likelihood.name} has censored readings, of which new ones cannot be drawn"
        is_measured = likelihood.readings.is_measured
        if (is_measured.sum(axis=1) < likelihood.coordinates.size).any():
            return f"{likelihood.name} has specimens with fewer readings than inputs"
        if not likelihood.error_is_known:
            return f"{likelihood.name} has an unknown reading error"
    return None


@dataclass(frozen=True, eq=False)
class SpecimenPool:
    """Simulated specimens of one likelihood with the points of each."""

    copies: int  # simulated specimens for each observed one, with its group and missing outputs
    points: list[Floats]  # (copies * N, K, *event): inputs
    log_a: Floats  # (copies * N, K): the numbers A
    z: Floats  # (copies * N, K, d): coordinates of the points

    def data_set(self, rng: np.random.Generator) -> tuple[list[Floats], Floats]:
        """Return points and numbers A of one data set of N specimens."""
        n = len(self.log_a) // self.copies
        rows = rng.integers(0, self.copies, n) * n + np.arange(n)
        return [x[rows] for x in self.points], self.log_a[rows]


def specimen_pool(
    likelihood: SpecimenLikelihood,
    params: Mapping[Any, Floats],
    rng: np.random.Generator,
    size: int = 2000,
) -> SpecimenPool:
    """Simulate specimens of one population, and draw their points.

    ``params`` has the values of the variables without the group, (1, *shape). ``size`` is rounded
    up to a multiple of the number of observed specimens.
    """
    n = len(likelihood.readings)
    copies = max(1, -(-size // n))
    values = draw_readings(likelihood, rng, params, copies * n)[0].reshape(copies * n, -1)
    observed, shape = likelihood.readings, values.shape
    missing = np.full(shape, np.nan)
    readings = Readings(
        np.where(np.resize(observed.is_measured, shape), values, np.nan),
        np.resize(observed.error, shape),
        np.resize(observed.step, shape),
        missing,
        missing,
        np.resize(observed.is_relative, shape),
    )
    options = likelihood.options
    # The tolerance is that of the log-likelihood of a data set, not of the pool.
    options = replace(options, half_difference=options.half_difference * np.sqrt(copies))
    emulation = prepared(likelihood).emulation
    roots = specimen_roots(emulation, readings, options)

    def values_alone(z: Floats) -> tuple[Floats, Floats]:
        # Points take no Jacobian, which costs more than the values.
        outputs = emulation.surface.values(z)
        outputs[emulation.fails(z)] = np.nan
        return outputs, np.empty((len(z), 0, 0))

    points = draw_points(
        values_alone, emulation.error, readings, roots, emulation.box, options, seed=1
    )
    log_a = points.log_a + likelihood.coordinates.log_jacobian(points.z)
    return SpecimenPool(copies, likelihood.coordinates.inputs(points.z), log_a, points.z)


@contextmanager
def other_specimens(
    likelihoods: Sequence[SpecimenLikelihood],
    data: Sequence[tuple[list[Floats], Floats]],
) -> Iterator[None]:
    """Give compiled likelihoods the points and numbers A of other specimens within the context."""
    shared = [arrays(likelihood) for likelihood in likelihoods]
    before = [([x.get_value() for x in points], log_a.get_value()) for points, log_a in shared]
    try:
        _set(shared, data)
        yield
    finally:
        _set(shared, before)


def _set(shared: Sequence[Any], data: Sequence[tuple[list[Floats], Floats]]) -> None:
    for (points, log_a), (new_points, new_log_a) in zip(shared, data, strict=True):
        for variable, value in zip(points, new_points, strict=True):
            variable.set_value(np.ascontiguousarray(value), borrow=True)
        log_a.set_value(np.ascontiguousarray(new_log_a), borrow=True)


@dataclass(frozen=True, eq=False)
class Refit:
    """The estimate of one simulated data set."""

    theta: Floats  # (d,)
    converged: bool
    data: list[tuple[list[Floats], Floats]]  # points and numbers A, by likelihood


@dataclass(frozen=True, eq=False)
class SpecimenRefits:
    """Maximum-likelihood estimates around an optimum."""

    evaluator: Evaluator
    theta: Floats  # (d,): start of all estimates
    covariance: Floats  # (d, d): unit of the parameters, or the prior's spread if not finite

    @property
    def _function(self) -> Any:
        """The compiled (theta, *weights) -> minus the weighted log-likelihood, gradient."""
        return self.evaluator.cached("weighted log-likelihood", self._compile)

    def _compile(self) -> Any:
        evaluator = self.evaluator
        with untraced():
            graphs = specimen_graphs(evaluator)
            weights = [pt.dvector(f"weights_{k}") for k in range(len(graphs))]
            terms = [
                pt.switch(pt.gt(w, 0), w * g, 0.0).sum()
                for w, g in zip(weights, graphs, strict=True)
            ]
            (value,), theta = evaluator.hyperparameters.joined([-sum(terms)])
            gradient = pt.grad(value, theta)
            return compiled([theta, *weights], ninf_for_invalid([value, gradient]))

    @cached_property
    def _root(self) -> Floats:
        """Root of the covariance: estimates are searched in its units, (d, d)."""
        if np.isfinite(self.covariance).all():
            values, vectors = np.linalg.eigh(self.covariance)
            if values.min() > 0:
                return np.asarray(vectors * np.sqrt(values))
        return np.diag(self.evaluator.hyperparameters.prior_sd)

    def fit(self, weights: Sequence[Floats] | None = None) -> tuple[Floats, bool]:
        """Return the estimate, (d,), and whether its search converged.

        ``weights`` of the specimens, (N,) by likelihood with sum N, are one by default.
        """
        from scipy.optimize import minimize as scipy_minimize

        if weights is None:
            weights = [np.ones(len(each.readings)) for each in self.evaluator.likelihoods]
        root = self._root

        def objective(u: Floats) -> tuple[float, Floats]:
            value, gradient = self._function(self.theta + root @ u, *weights)
            if not np.isfinite(value):
                return np.inf, np.zeros_like(u)
            return float(value), root.T @ np.where(np.isfinite(gradient), gradient, 0.0)

        result = scipy_minimize(
            objective,
            np.zeros(self.theta.size),
            jac=True,
            method="BFGS",
            options={"gtol": 1e-3, "maxiter": 200},
        )
        slope = np.abs(objective(result.x)[1]).max()
        return self.theta + root @ result.x, bool(np.isfinite(result.fun) and slope < 0.05)

    @cached_property
    def _pools(self) -> dict[int, list[SpecimenPool]]:
        return {}

    def pools(self, seed: int) -> list[SpecimenPool]:
        """Return a pool of simulated specimens of the optimum for each likelihood."""
        if seed not in self._pools:
            rng = np.random.default_rng([seed, 21])
            evaluator = self.evaluator
            self._pools[seed] = [
                specimen_pool(likelihood, specimen_params(evaluator, self.theta[None], k), rng)
                for k, likelihood in enumerate(evaluator.likelihoods)
            ]
        return self._pools[seed]

    def simulated(self, draws: int, seed: int) -> Iterator[Refit]:
        """Yield estimates of data sets simulated at the optimum."""
        pools = self.pools(seed)
        rng = np.random.default_rng([seed, 22])
        for _ in range(draws):
            data = [pool.data_set(rng) for pool in pools]
            with other_specimens(self.evaluator.likelihoods, data):
                theta, converged = self.fit()
            yield Refit(theta, converged, data)

    def reweighted(self, weights: Sequence[Floats]) -> tuple[Floats, NDArray[np.bool_]]:
        """Return estimates of weighted data sets, (S, d), and which converged.

        ``weights``, (S, n_k), are of the specimens of each of `Evaluator.emulated`, with any sum.
        """
        by_likelihood = []
        emulated = self.evaluator.emulated
        for likelihood in self.evaluator.likelihoods:
            factors = np.zeros((len(weights[0]), len(likelihood.readings)))
            count = np.zeros(len(likelihood.readings))
            for simulator, part in zip(emulated, weights, strict=True):
                if simulator.likelihood is likelihood:
                    specimens = specimen_numbers(likelihood, simulator.measurement)[simulator.rows]
                    np.add.at(factors.T, specimens, part.T * len(specimens))
                    np.add.at(count, specimens, 1)
            factors /= count
            stated = likelihood.measurements[0].weights
            if stated is not None:  # which are in the likelihood, and in the weights
                factors = factors / np.where(stated > 0, stated, 1.0)
            by_likelihood.append(factors)
        estimates = [self.fit(list(rows)) for rows in zip(*by_likelihood, strict=True)]
        thetas, converged = zip(*estimates, strict=True)
        return np.array(thetas), np.array(converged)


def is_specimen_optimum(result: object) -> bool:
    """Return whether a result is an optimum of log-likelihoods by specimen without a metric."""
    return isinstance(result, Optimum) and not result.evaluator.nodes


def specimen_refits(optimum: Optimum, caller: str, *, simulated: bool = False) -> SpecimenRefits:
    """Return the refits around an optimum, or raise if the model cannot be fitted to other data."""
    evaluator = require_sampling(optimum, caller).evaluator
    find = simulation_obstacle if simulated else specimen_refit_obstacle
    obstacle = find(evaluator)
    if obstacle is not None:
        raise ValueError(f"{caller}: {obstacle}; use prb.sample_smc")
    require_minimiser(optimum, caller)
    return SpecimenRefits(evaluator, optimum.theta, optimum.covariance)
