"""`Optimum`: what `minimize` returns."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats
from prbayes.information import Local
from prbayes.population import Evaluator
from prbayes.search import Search


@dataclass(frozen=True, eq=False, repr=False)
class Optimum:
    """The result of `minimize`; numerical failure is a value in it, not an exception.

    Attributes
    ----------
    point : dict
        Hyperparameters and deterministics by name, in the user's own units.
    discrepancy : float
        The minimised sum of d_k / s_k; with one simulator, its discrepancy.
    discrepancies : dict
        Discrepancy by simulator.
    scales : dict
        The s_k by simulator.
    n_evaluations : int
        Evaluations of the objective by the optimiser; one with an exact gradient counts as one, each of those that
        make a gradient by differences counts too.
    n_screened : int
        Points of the prior that were tried as starting points, in one batch.
    n_responses : int
        Scalar responses that this optimum took, the design's included, and those found in a store; `n_computed` has
        how many were computed.
    converged : bool
    message : str
        What the optimiser said.
    stderr : dict
        Standard errors by name, in the user's own units: the estimator's sampling standard deviation;
        infinite along directions that the data do not identify; NaN where nothing is known, as at the edge
        of a support.
    covariance : ndarray, shape (d, d)
        Sampling covariance in unconstrained space.
    theta : ndarray, shape (d,)
        The optimum in unconstrained space.
    names : list of str
        Names of the elements of theta.
    support : dict
        By simulator with `Reweighted`: ``weight_ess``, ``mean_weight`` and ``lost_mass`` at the optimum.
    trace : dict
        ``theta`` (n, d), ``discrepancy`` (n,) and ``evaluations`` (n,) of each point that the optimiser asked for:
        unconstrained hyperparameters, the objective there, and how many evaluations there were until then.
    seconds : float
    design_error : float
        How far the optimum of an independent design of the same size would be, in standard errors, along the worst
        direction; NaN where it is not known (`Resimulated`) or is negligible (one input).
    rivals : tuple of dict
        Other optima, such as mirror solutions: ``point``, ``discrepancy`` (the sum of d_k / s_k), ``theta``, and
        ``comparable``, whether the data could as well come from there.
    warnings : tuple of str
        What is not identified, in sentences; also logged.
    at_edge : tuple of str
        Elements that went far out, where no change of them changes the discrepancy: their best value is at the edge of
        the support, the optimiser has not converged, and nothing is known of standard errors.
    at_jump : tuple of str
        Simulators whose discrepancy jumps at the optimum, since points lose their response there: nothing is known of
        standard errors.
    """

    point: dict[str, Any]
    discrepancy: float
    discrepancies: dict[str, float]
    scales: dict[str, float]
    n_evaluations: int
    n_screened: int
    n_responses: int
    converged: bool
    message: str
    stderr: dict[str, Any]
    covariance: Floats
    theta: Floats
    names: list[str]
    evaluator: Evaluator
    support: dict[str, dict[str, float]] = field(default_factory=dict)
    trace: dict[str, Floats] = field(default_factory=dict)
    seconds: float = 0.0
    design_error: float = np.nan
    rivals: tuple[dict[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()
    at_edge: tuple[str, ...] = ()
    at_jump: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Show the answer, what it cost, and what is to be said of it."""
        found = [f"{name} = {_short(value)} ± {_short(self.stderr[name])}" for name, value in self.point.items()]
        state = "converged" if self.converged else "NOT converged"
        cost = f"{self.n_evaluations} evaluations, {self.n_responses} responses, {state}"
        return "\n  ".join([f"Optimum: discrepancy {self.discrepancy:.4g} after {cost}", *found, *self.warnings])

    @property
    def model(self) -> pm.Model:
        """The model."""
        return self.evaluator.model

    @property
    def n_computed(self) -> int:
        """Responses computed for the model so far: without those found in a store, with those computed again."""
        return sum(node.bound.responses.computed for node in self.evaluator.nodes)

    def to_datatree(self) -> xr.DataTree:
        """Return the optimum as a DataTree with groups ``optimum``, ``stderr``, ``trace`` and ``calibration``."""
        from prbayes.results import optimum_tree

        return optimum_tree(self)


def _short(value: Any) -> str:
    return np.array2string(np.asarray(value), precision=4, threshold=8, formatter={"float_kind": "{:.4g}".format})


def assemble(
    evaluator: Evaluator,
    theta: Floats,
    scales: Floats,
    local: Local | None,
    search: Search,
    result: Any,
    screened: int,
    computed: int,
    clock: float,
) -> Optimum:
    """Return the record of a search that has ended at theta."""
    covariance = np.full((theta.size, theta.size), np.nan) if local is None else local.in_theta
    step = 1e-4 * search.scale
    rows = np.vstack([theta, *(theta + s * e for e in np.diag(step) for s in (1, -1))])
    values = evaluator.constrained(rows)
    stderr = {}
    for name, v in values.items():
        slopes = np.moveaxis((v[1::2] - v[2::2]), 0, -1) / (2 * step)
        blind = np.isinf(covariance)
        variance = np.einsum("...i,ij,...j->...", slopes, np.where(blind, 0.0, covariance), slopes)
        touched = np.einsum("...i,ij,...j->...", np.abs(slopes), blind.astype(float), np.abs(slopes))
        at_edge = blind.any() & (slopes == 0).all(axis=-1)
        variance = np.where(at_edge, np.nan, np.where(touched > 0, np.inf, np.maximum(variance, 0)))
        stderr[name] = plain(np.sqrt(variance))
    variance = np.diag(covariance) / search.scale**2  # where nothing changes, that of rounding errors
    nowhere = bool((np.isinf(variance) | (variance < 1e-16)).all()) and flat(evaluator, theta, search.scale)
    lost = " No hyperparameter changes the discrepancy here, far from the data: try another start." if nowhere else ""
    found = evaluator(theta[None])
    discrepancies = dict(zip([n.name for n in evaluator.nodes], map(float, found.discrepancies[0]), strict=True))
    return Optimum(
        point={name: plain(v[0]) for name, v in values.items()},
        discrepancy=float((found.discrepancies[0] / scales).sum()),
        discrepancies=discrepancies,
        scales=dict(zip(discrepancies, map(float, scales), strict=True)),
        n_evaluations=search.count,
        n_screened=screened,
        n_responses=evaluator.n_responses - computed,
        converged=bool(result.success) and not nowhere,
        message=f"{result.message}{search.remark}{lost}",
        stderr=stderr,
        covariance=covariance,
        theta=theta,
        names=evaluator.names,
        evaluator=evaluator,
        support={
            name: {key: float(value[0]) for key, value in support.items()}
            for name, support in evaluator.support(theta[None]).items()
        },
        trace={
            "theta": np.array(search.thetas).reshape(-1, theta.size),
            "discrepancy": np.array(search.values),
            "evaluations": np.array(search.counts, dtype=np.int64),
        },
        seconds=time.perf_counter() - clock,
    )


def surveyed(optimum: Optimum, caller: str) -> Optimum:
    """Return the optimum, or raise where nothing is known of the discrepancy around it.

    Raises
    ------
    ValueError
        If it is at the edge of a support, or at a jump.
    """
    lines = trouble(optimum.at_edge, optimum.at_jump)
    if lines:
        raise ValueError(
            f"{caller}: got an optimum around which nothing is known: {'; '.join(lines)}. "
            "prb.sample_smc(epsilon=..., adjust=False) makes no use of it"
        )
    return optimum


def trouble(at_edge: tuple[str, ...], at_jump: tuple[str, ...]) -> list[str]:
    """Say that elements are at the edge of their support, and that simulators jump."""
    lines = []
    if at_edge:
        lines.append(
            f"{', '.join(at_edge)} ran to the edge of the support, where the discrepancy no longer changes; perhaps "
            "the population has collapsed within the bandwidth of the metric: use a smaller bandwidth, or "
            "prb.AreaMetric(), which has none"
        )
    if at_jump:
        lines.append(
            f"{', '.join(at_jump)}: points lose their response at the optimum, and the discrepancy jumps there by more "
            "than it changes otherwise: use prb.AreaMetric(), prb.Reweighted(), or more responses"
        )
    return lines


def flat(evaluator: Evaluator, theta: Floats, scale: Floats) -> bool:
    """Whether no discrepancy changes around theta, as where populations and observed values do not overlap."""
    around = np.vstack([theta, *(theta + s * e for e in np.diag(0.01 * scale) for s in (1, -1))])
    found = evaluator(around).discrepancies
    with np.errstate(invalid="ignore"):
        return bool(((found == found[0]) | (np.abs(found - found[0]) <= 1e-12 * np.abs(found[0]))).all())


def plain(value: Any) -> Any:
    """Return a float, or an array where there are several numbers."""
    return float(value) if np.ndim(value) == 0 else np.asarray(value)
