"""Expected information of further specimens: posterior standard deviations that they would give."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from pytensor.graph.basic import Variable
from scipy.special import ndtri
from scipy.stats import rankdata

from prbayes._display import Table, View
from prbayes._finding import Finding, Findings, as_json, counted, report, sentences_of
from prbayes._stats import positive_scale, reached
from prbayes._validate import (
    Arrays,
    Floats,
    Function,
    StrPath,
    called,
    complete_rows,
    flat_rows,
    positive_integer,
    positive_number,
    wrong_value,
)
from prbayes.decision.populations import (
    InverseTransform,
    Populations,
    ResponseSample,
    checked_by_family,
    standard_deviation,
)
from prbayes.decision.quantities import Quantity, refuse_quantity
from prbayes.inference.refits import SamplingDistribution, drawn_in
from prbayes.inference.resampling import observable
from prbayes.metrics.base import Metric
from prbayes.metrics.readings import Readings, add_errors, has_error
from prbayes.model.description import labelled
from prbayes.model.emulated import EmulatedSimulator
from prbayes.model.locking import locked
from prbayes.model.measurement import unit_readings
from prbayes.model.parameters import split_elements, table_elements, variables_at
from prbayes.numerics.derivatives import cross, slopes
from prbayes.numerics.modes import rows_by_mode
from prbayes.optimize.optimum import Optimum
from prbayes.response.discrepancy import findings_of
from prbayes.response.response import refuse_uncallable
from prbayes.results.predict import call_settings


class Condition:
    """A condition under which specimens could be tested: a response, its inputs, and a metric.

    Parameters
    ----------
    response : callable
        As for `Simulator`: that of a simulator of the model, or another one of the same specimens.
    *inputs
        As for `predict`.
    metric : Metric, optional
        Of its data; that of the model's simulator by default. Under the log-likelihood by specimen
        it is a `LogLikelihood` with the error of the readings.

    Raises
    ------
    TypeError
        If an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> prb.decision.Condition(np.square, pm.Normal.dist(), metric=prb.AreaMetric())
    Condition of square
    """

    def __init__(self, response: Function, *inputs: Any, metric: Metric | None = None) -> None:
        caller = "prb.decision.Condition"
        refuse_uncallable(caller, response, order="Condition(response, *inputs)")
        if metric is not None and not isinstance(metric, Metric):
            raise wrong_value(
                metric,
                "prb.decision.Condition: metric",
                "a metric, such as prb.ProbabilityResidual()",
            )
        self.response = response
        self.inputs = inputs
        self.metric = metric

    def __repr__(self) -> str:
        return f"Condition of {getattr(self.response, '__name__', type(self.response).__name__)}"


@locked
def plan(
    result: Optimum | xr.DataTree,
    candidates: Mapping[str, Condition],
    *,
    k: int | Sequence[int] = (5, 10, 20, 50),
    model: pm.Model | None = None,
    quantity: Quantity | None = None,
    max_sd: Mapping[str, float] | None = None,
    executor: Executor | None = None,
    store: StrPath | None = None,
    version: str | None = None,
) -> PlanTable:
    r"""Predict standard deviations after k more specimens under each candidate condition.

    The posterior has the precision :math:`\Lambda` of its draws. One specimen under a condition
    adds the metric's (Godambe) information :math:`a = H J^{-1} H`, with the Hessian H of its
    discrepancy at the centre and the covariance J of its gradient, both by the weights of stored
    responses. It is at most the Fisher information of the response. After k specimens the expected
    covariance of the draws is :math:`(\Lambda + k a)^{-1}`. If the draws have several modes, this
    applies within each mode, and the modes keep their masses.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution, and then without the prior; or with a
        ``posterior`` group, from any sampler.
    candidates : mapping of str to Condition
        Conditions by name. A response other than a simulator's is computed once for each run of
        the design, unless `predict` has computed it.
    k : int or sequence of int
        Numbers of further specimens.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    quantity : Quantity, optional
        A decision quantity whose standard deviation is predicted as well.
    max_sd : mapping of str to float, optional
        Largest acceptable standard deviations, by names of the table, in the unit of each; that of
        the quantity by ``"quantity"``.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    store : path-like, optional
        A folder that keeps every computed response, by its name.
    version : str, optional
        Of the response, for the store; as for `Reweighted`.

    Returns
    -------
    xarray.Dataset
        Dimensions ``candidate``, ``k`` and ``name``: hyperparameters and deterministics, and
        ``"quantity"``. Variables ``sd``, the expected standard deviation in the user's units, inf
        where the quantity is infinite in some populations; ``now``, the present one; and with
        ``max_sd``, ``specimens``: the smallest number that suffices, inf if a million do not, NaN
        of other names. Attributes: ``responses`` (number computed), ``findings`` (as JSON),
        ``identity``, and with a quantity ``value_error``, the standard error of its value from
        points and emulator, which more specimens do not reduce. It prints as sentences; a notebook
        shows a table.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses.
    DesignError
        If the design does not support the populations.
    ResponseError
        If a response raises, or has the wrong shape.

    Notes
    -----
    This is an expectation at the centre of the result: an actual posterior after k specimens has
    another centre and width. Specimens are new, each measured once under one condition. Numbers
    below ten are less reliable, as information adds up in large samples. Gross errors of readings
    are not counted.

    References
    ----------
    .. [1] Chaloner, K. and I. Verdinelli (1995), Bayesian experimental design: a review, Stat. Sci.
       10, 273-304, doi:10.1214/ss/1177009939.
    .. [2] Godambe, V. P. (1960), An optimum property of regular maximum likelihood estimation, Ann.
       Math. Stat. 31, 1208-1211, doi:10.1214/aoms/1177705693.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1), name="x")
    ...     data = np.random.default_rng(1).normal(0, 1, 50)
    ...     metric = prb.LogLikelihood(density=prb.GaussianKDE())
    ...     y = prb.Simulator("y", np.sinh, x, metric=metric, observed=data)
    >>> same = prb.decision.Condition(np.sinh, x)
    >>> table = prb.plan(prb.minimize(model), {"same": same}, k=150)
    >>> ratio = table.sd.sel(candidate="same", k=150, name="mu") / table.now.sel(name="mu")
    >>> bool(abs(ratio - 0.5) < 0.05)
    True
    """
    caller = "prb.plan"
    numbers = _validated_counts(k)
    _refuse_candidates(candidates)
    if quantity is not None:
        refuse_quantity(quantity, caller)
    # With 2000 draws standard deviations have an error of two percent.
    populations = Populations.of(
        result, model, 2000, caller, call_settings(executor, store, version)
    )
    quantity_sample = None
    findings: Findings = ()
    if quantity is not None:
        quantity_sample = populations.sample(quantity.response, quantity.inputs, quantity.output)
        findings, error = checked_by_family(quantity_sample, quantity)
    unit = populations.evaluator.hyperparameters.prior_sd
    modes = [populations.thetas[rows] for rows in rows_by_mode(populations.thetas / unit)]
    findings += report(*_several_modes(populations, modes))
    draws = [Draws.of(thetas, unit) for thetas in modes]
    forecast = _Forecast(populations, draws, quantity, quantity_sample)
    now = forecast.sd([np.zeros((unit.size, unit.size))] * len(modes))
    _refuse_max_sd(max_sd, list(now))
    is_single = len(modes) == 1
    centers = [populations.center if is_single else np.median(thetas, axis=0) for thetas in modes]
    samples = {
        name: populations.sample_of_all_outputs(condition.response, condition.inputs)
        for name, condition in candidates.items()
    }
    findings = _with_findings_of(candidates, findings)
    sd, specimens = [], []
    for name, condition in candidates.items():
        information = [
            specimen_information(samples[name].around(center), condition.metric)
            for center in centers
        ]
        rows = [forecast.sd([number * a for a in information]) for number in numbers]
        sd.append([[row[element] for element in now] for row in rows])
        specimens.append(
            [forecast.needed(information, element, (max_sd or {}).get(element)) for element in now]
        )
    variables = {
        "sd": (["candidate", "k", "name"], sd),
        "now": ("name", list(now.values())),
    }
    if max_sd is not None:
        variables["specimens"] = (["candidate", "name"], specimens)
    count = sum(sample.responses.count for sample in samples.values())
    count += 0 if quantity_sample is None else quantity_sample.responses.count
    return PlanTable(
        variables,
        coords={"candidate": list(candidates), "k": numbers, "name": list(now)},
        attrs={
            "responses": count,
            "findings": as_json(findings),
            **({} if quantity is None else {"quantity": repr(quantity), "value_error": error}),
            **populations.provenance(),
        },
    )


def _with_findings_of(candidates: Mapping[str, Condition], findings: Findings) -> Findings:
    """Return findings and those of the candidates' responses, each once."""
    responses = [condition.response for condition in candidates.values()]
    of_candidates = [finding for response in responses for finding in findings_of(response)]
    return tuple(dict.fromkeys([*findings, *of_candidates]))


def _several_modes(populations: Populations, modes: Arrays) -> Findings:
    """Report modes of the draws, and other optima of an optimum, which is one mode alone."""
    page = "likelihood_findings.md#several-modes"
    if isinstance(populations.result, Optimum):
        return tuple(f for f in populations.result.findings if f.code == "second-mode")
    if len(modes) == 1:
        return ()
    masses = ", ".join(f"{len(thetas) / len(populations.thetas):.0%}" for thetas in modes)
    text = (
        f"The posterior has {len(modes)} modes with {masses} of the draws: the expected standard "
        "deviations are those within the modes and between them. Specimens whose responses differ "
        "between the modes, such as those of another output, exclude modes and give smaller ones."
    )
    return (Finding("second-mode", text, page),)


class PlanTable(Table):
    """Expected standard deviations after more specimens."""

    __slots__ = ()
    _parts = ("sd", "now", "candidate", "k", "name", "findings")
    _columns = ("sd", "now", "specimens")

    def to_view(self) -> View:
        """Return what a reader sees."""
        rows = []
        for name in self["name"].values:
            for candidate in self["candidate"].values:
                row = self.sel(name=name, candidate=candidate)
                cells = [f"{float(x):.4g}" for x in (row["now"], *row["sd"])]
                if "specimens" in self:
                    needed = float(row["specimens"])
                    cells.append("" if np.isnan(needed) else f"{needed:.0f}")
                rows.append([str(name), str(candidate), *cells])
        header = ["", "condition", "now", *(f"{k} more" for k in self["k"].values)]
        header += ["needed for max_sd"] if "specimens" in self else []
        sentences = sentences_of(self.attrs)
        if "quantity" in self.attrs:
            sentences.append(f"quantity: {self.attrs['quantity']}.")
        heading = "Expected standard deviations after more specimens"
        return View(heading, header, rows, sentences)


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of theta, and their covariance."""

    thetas: Floats  # (k, d)
    unit: Floats  # (d,): the prior's spread
    covariance: Floats  # (d, d): covariance in that unit

    @classmethod
    def of(cls, thetas: Floats, unit: Floats) -> Draws:
        """Return draws, (k, d), with a covariance in which outliers are moved to 3 sd."""
        d = unit.size
        covariance = np.cov(drawn_in(thetas / unit), rowvar=False).reshape(d, d)
        return cls(thetas, unit, covariance)

    def with_information(self, information: Floats) -> Floats:
        """Return the draws after information, (d, d), narrowed around the same median.

        Precisions add up. The map between the two normal distributions is the symmetric one.
        """
        covariance = np.linalg.inv(np.linalg.inv(self.covariance) + information)
        root = _square_root(self.covariance)
        inverse = np.linalg.inv(root)
        matrix = inverse @ _square_root(root @ covariance @ root) @ inverse
        median = np.median(self.thetas, axis=0)
        deviation = (self.thetas - median) / self.unit
        return median + (deviation @ matrix.T) * self.unit


def _square_root(matrix: Floats) -> Floats:
    """Return the symmetric square root."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


@dataclass(frozen=True, eq=False)
class _Forecast:
    """Standard deviations after more information."""

    populations: Populations
    draws: Sequence[Draws]  # draws of each mode
    quantity: Quantity | None
    sample: ResponseSample | None  # responses that the quantity is computed from

    def _thetas(self, information: Arrays) -> Floats:
        """Return the draws of all modes after information, (d, d) of each mode."""
        pairs = zip(self.draws, information, strict=True)
        return np.concatenate([draws.with_information(a) for draws, a in pairs])

    def sd(self, information: Sequence[Floats]) -> dict[str, float]:
        """Return standard deviations by name after information, (d, d) of each mode."""
        thetas = self._thetas(information)
        evaluator = self.populations.evaluator
        variables = evaluator.hyperparameters.constrained(thetas)
        values = labelled(evaluator, variables, {"draw": len(thetas)}).data_vars
        elements = split_elements(values)
        sd = {name: float(elements[name].std()) for name in table_elements(values)}
        if self.quantity is not None:
            sd["quantity"] = self._quantity_sd(thetas)
        return sd

    def _quantity_sd(self, thetas: Floats) -> float:
        """Return the standard deviation of the quantity."""
        assert self.quantity is not None
        assert self.sample is not None
        return standard_deviation(self.sample.evaluate(self.quantity.of, thetas))

    def needed(self, information: Arrays, name: str, max_sd: float | None) -> float:
        """Return the smallest sufficient number of specimens: inf if none, NaN without a limit."""
        if max_sd is None:
            return np.nan

        def exceeds(n: int) -> bool:
            increase = [n * a for a in information]
            if name == "quantity":
                return self._quantity_sd(self._thetas(increase)) > max_sd
            return replace(self, quantity=None).sd(increase)[name] > max_sd

        if not exceeds(0):
            return 0.0
        enough = 1
        while exceeds(enough):
            enough *= 2
            if enough > 2_000_000:
                return np.inf
        short = enough // 2
        smallest = bisect_left(
            range(enough), True, lo=short + 1, key=lambda number: not exceeds(number)
        )
        return float(smallest)


# -- information of one specimen -------------------------------------------------------------------


def specimen_information(sample: ResponseSample, metric: Metric | None) -> Floats:
    r"""Return the information of one specimen, (d, d), in units of the prior's spread.

    The Godambe information :math:`H J^{-1} H` of an ideal sample of the central population, divided
    by its size, and at most the Fisher information of the response. For a simulator with the
    log-likelihood by specimen, the Fisher information of its readings.
    """
    evaluator = sample.populations.evaluator
    center = sample.populations.center
    design = sample.design
    if not design.has_runs:
        _refuse_moving_support(sample)
        return fisher_information(sample, ReadingErrors.of(sample, metric))
    node = evaluator.nodes[sample.k]
    if metric is None and node.metric.exact_likelihood:  # new specimens are known themselves
        return fisher_information(sample)
    # The ideal sample has specimens at equal steps of probability, at least 50 of them because
    # smaller samples have other bandwidths.
    n = max(round(node.n_specimens), 50)
    is_observable = observable(sample.outputs, node.target)
    values = sample.outputs[is_observable]
    mass = sample.masses(center[None])[0, is_observable]
    order = np.argsort(flat_rows(values)[:, 0])
    rows = order[reached(mass[order], (np.arange(n) + 0.5) / n, normalized=True)]
    target = (metric or node.metric).against(values[rows])
    bound = design.copied(design.design.with_values(sample.outputs))
    bound.target = target.metric.for_inputs(target, design.inputs.dimensions)
    alone = replace(node, target=bound.target, bound=bound, specimens=None)
    # Count directions with a standard error of up to ten prior standard deviations. Fainter ones
    # have less than a hundredth of the prior's information.
    simulator_alone = replace(evaluator, nodes=(alone,), has_graph=False)
    local = SamplingDistribution.of(simulator_alone, center, np.ones(1), 10.0).local
    if not local.identified.size:
        return np.zeros((center.size, center.size))
    information = local.identified @ np.linalg.inv(local.covariance) @ local.identified.T
    return _at_most(information / n, fisher_information(sample))


def _refuse_moving_support(sample: ResponseSample) -> None:
    """Raise if the ends of the inputs' populations depend on hyperparameters.

    The extreme specimens determine such ends. They are no part of the Fisher information.
    """
    populations, name = sample.populations, sample.responses.name
    center = sample.parents(populations.center[None])
    try:
        transform = InverseTransform(name, sample.design.inputs, center)
    except TypeError:  # without an inverse distribution function, as of several normal inputs
        return
    of_draws = sample.parents(populations.thinned())
    if not transform.has_support_of(of_draws):
        raise ValueError(
            f"prb.plan: {name}: got inputs whose support moves with their hyperparameters, as of a "
            "uniform population, to which the information of specimens does not apply; draw more "
            "specimens from the calibrated population, and calibrate them"
        )


@dataclass(frozen=True, eq=False)
class ReadingErrors:
    """Errors, rounding and limits of the readings of a response."""

    readings: Readings  # readings whose errors and steps apply, and repeat if there are more points
    unknown: Variable | None  # model variable that is the error, if it is unknown
    limits: tuple[Any, Any]  # lower and upper limits, NaN without a limit

    @classmethod
    def of(cls, sample: ResponseSample, metric: Metric | None) -> ReadingErrors | None:
        """Return the errors of a metric, or of the simulator; None if readings are exact."""
        simulator = sample.populations.evaluator.simulators[sample.k]
        assert isinstance(simulator, EmulatedSimulator)
        measurement = simulator.measurement
        label = f"prb.plan: {sample.responses.name}"
        event = sample.outputs.shape[1:]
        likelihood: Any = measurement.metric if metric is None else metric
        if not likelihood.by_specimen:
            raise ValueError(
                f"{label}: metric: got {metric!r} of a simulator with the log-likelihood by "
                "specimen, whose posterior uses the whole information of the readings; leave "
                "metric= out, or pass prb.LogLikelihood(error=...)"
            )
        roles = measurement.extras if metric is None else likelihood.roles
        roles = {role: roles[role] for role in likelihood.roles if role in roles}
        variables = [x for x in roles.values() if isinstance(x, Variable)]
        readings = unit_readings(measurement)
        if metric is not None:
            readings = likelihood.readings(np.zeros((1, sample.outputs[0].size)), None, event)
        is_normal = (readings.family < 0).all() and "bias" not in roles
        if variables and not (is_normal and len(likelihood.roles) == 1):
            raise ValueError(
                f"{label}: got readings with the unknown {', '.join(map(str, variables))}, "
                "expected known parameters, or one unknown error; pass a metric with numbers to "
                "prb.decision.Condition"
            )
        unknown = variables[0] if variables else None
        if not (has_error(readings).any() or readings.step.any() or likelihood.censored):
            return None
        size = sample.outputs[0].size
        size_of_model = readings.values.shape[1]
        if size != size_of_model:
            raise ValueError(
                f"{label}: got {counted(size, 'output')}, expected {size_of_model}, as "
                f"{simulator.name} has, whose readings have errors; pass "
                "metric=prb.LogLikelihood(error=...) to prb.decision.Condition"
            )
        low, high = likelihood.censored or (None, None)
        limits = (np.nan if low is None else low, np.nan if high is None else high)
        return cls(readings, unknown, limits)

    def draw(
        self, outputs: Floats, scores: Floats, values: Mapping[str, Floats], step: Floats
    ) -> tuple[Floats, Floats]:
        """Return readings of outputs, (n, m), and scores, (n, d), of inputs and errors.

        ``values`` are the variables at a cross of thetas with steps (d,), ``scores`` those of
        inputs.
        """
        shape, factor = outputs.shape, np.ones(())
        if self.unknown is not None:
            normal = np.random.default_rng(0).standard_normal(shape)
            logs = np.log(values[str(self.unknown.name)]).reshape(1 + 2 * step.size, -1)
            factor = np.exp(logs[0])
            by_output = np.broadcast_to(slopes(logs, step), (shape[1], step.size))
            scores = scores + (normal**2 - 1) @ by_output
        like = self.readings.rows(np.resize(np.arange(len(self.readings)), len(outputs)))
        result = add_errors(like, np.random.default_rng(0), outputs[None], factor, factor)[0]
        lowest, highest = (np.resize(limit, shape) for limit in self.limits)
        return np.fmin(np.fmax(result, lowest), highest), scores  # NaN is no limit


def fisher_information(sample: ResponseSample, errors: ReadingErrors | None = None) -> Floats:
    r"""Return the Fisher information of one specimen, (d, d), in units of the prior's spread.

    The covariance of the score of a response, :math:`E[s(x) | y]`: the mean over bins of the
    response of the score of the inputs, which is the derivative of their log weights. For several
    outputs the covariance of the inputs' score, an upper bound; if they are readings with errors,
    of its projection on quadratic functions of the readings.
    """
    evaluator = sample.populations.evaluator
    unit = evaluator.hyperparameters.prior_sd
    step = 1e-3 * unit
    thetas = cross(sample.populations.center, step)
    weights = sample.masses(thetas)
    outputs = sample.outputs
    if sample.design.has_runs:
        is_observable = observable(outputs, evaluator.nodes[sample.k].target)
    else:
        is_observable = complete_rows(flat_rows(outputs))
    is_used = (weights[0] > 0) & is_observable
    weights = weights[:, is_used]
    with np.errstate(divide="ignore", invalid="ignore"):
        scores = slopes(np.log(weights), step)
    mass = weights[0] / weights[0].sum()
    values = outputs[is_used].reshape(len(mass), -1)
    # The size of bins is half the root of the number of points. Equal values share a bin.
    size = max(1, int(np.sqrt(len(mass)) / 2))
    if errors is not None:
        copies = 16  # number of copies of each specimen, with different errors
        values = np.tile(values, (copies, 1))
        scores = np.tile(scores, (copies, 1))
        mass = np.tile(mass, copies) / copies
        variables = variables_at(evaluator.hyperparameters, thetas)
        values, scores = errors.draw(values, scores, variables, step)
        size = max(1, len(mass) // 128)
    scores = (scores - mass @ scores) * unit
    if outputs.ndim > 1:
        if errors is not None:
            scores = _projected(scores, values, mass)
        return np.asarray((scores.T * mass) @ scores)
    rank = np.searchsorted(np.sort(values[:, 0]), values[:, 0])
    bins = rank // size
    share = np.bincount(bins, mass)
    sums = np.array([np.bincount(bins, mass * column) for column in scores.T])
    means = sums / positive_scale(share)
    return (means * share) @ means.T


def _projected(scores: Floats, values: Floats, mass: Floats) -> Floats:
    """Return scores, (n, d), as quadratic functions of the normal scores of values, (n, m)."""
    z = ndtri((rankdata(values, axis=0) - 0.5) / len(values))
    # Keep eight principal components of many outputs, such as those of a curve.
    _, axes = np.linalg.eigh(z.T @ z)
    z = z @ axes[:, -8:]
    first, second = np.triu_indices(z.shape[1])
    products = z[:, first] * z[:, second]
    basis = np.column_stack([z, products])
    basis -= mass @ basis
    root = np.sqrt(mass)[:, None]
    coefficients = np.linalg.lstsq(root * basis, root * scores)[0]
    return np.asarray(basis @ coefficients)


def _at_most(information: Floats, bound: Floats) -> Floats:
    """Return information that exceeds a bound in no direction, (d, d).

    The response contains next to no information along some directions. There both factors of a
    sandwich are rounding errors, and their quotient is arbitrary.
    """
    if not np.isfinite(bound).all():  # if the support moves, and the likelihood gives no bound
        return information
    d = len(bound)
    root = np.linalg.cholesky(bound + 1e-9 * np.trace(bound) * np.eye(d))
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ information @ inverse.T)
    capped = (vectors * np.minimum(values, 1.0)) @ vectors.T
    return np.asarray(root @ capped @ root.T)


def _validated_counts(k: object) -> list[int]:
    """Return numbers of specimens, or raise."""
    if isinstance(k, str | Mapping) or not isinstance(k, Sequence | np.ndarray):
        return [positive_integer(k, "k")]
    if len(k) == 0:
        raise ValueError(
            "k: got no numbers, expected numbers of further specimens, such as [5, 10]"
        )
    return [positive_integer(number, "k") for number in k]


def _refuse_candidates(candidates: object) -> None:
    """Raise if candidates are no mapping of names to conditions."""
    advice = 'such as {"later": prb.decision.Condition(response, x)}'
    if not isinstance(candidates, Mapping) or not candidates:
        raise wrong_value(
            candidates, "prb.plan: candidates", f"a mapping of names to conditions, {advice}"
        )
    for name, condition in candidates.items():
        if not isinstance(name, str) or not isinstance(condition, Condition):
            raise TypeError(
                f"prb.plan: candidates: got {called(condition)} by {called(name)}, expected a "
                f"condition by a text, {advice}"
            )


def _refuse_max_sd(max_sd: object, names: list[str]) -> None:
    """Raise if a limit is no standard deviation by name."""
    if max_sd is None:
        return
    if not isinstance(max_sd, Mapping) or not max_sd:
        raise wrong_value(
            max_sd, "prb.plan: max_sd", f"a mapping of names to standard deviations, of {names}"
        )
    for name, value in max_sd.items():
        if name not in names:
            raise KeyError(f"prb.plan: max_sd: got {name!r}, expected one of {names}")
        positive_number(value, f"max_sd: {name}")
