"""Variance-based sensitivity of a decision quantity to hyperparameters and inputs.

Sobol' indices of first and total order, and derivative-based bounds, from replicates of scrambled
Sobol points.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pymc as pm
import xarray as xr
from scipy.special import ndtr, ndtri
from scipy.stats import rankdata

from prbayes._display import Table, View
from prbayes._finding import Finding, Findings, as_json, report, sentences_of
from prbayes._validate import (
    ArrayPair,
    Floats,
    Seed,
    StrPath,
    finite_or_nan,
    flag,
    positive_integer,
    seed_number,
)
from prbayes.decision.populations import (
    InverseTransform,
    Populations,
    ResponseSample,
    checked_by_family,
    standard_deviation,
)
from prbayes.decision.quantities import Quantity, refuse_quantity
from prbayes.model.locking import locked
from prbayes.numerics.points import sobol
from prbayes.optimize.optimum import Optimum
from prbayes.response.inputs import aleatory_names
from prbayes.results.predict import call_settings

# Number of independently scrambled point sets. The standard error between them has an error of 18
# %.
REPLICATES = 16
# Step of differences in standard normal numbers. Half or twice changes an index by less than a
# hundredth (tests/decision/test_sensitivity.py).
_STEP = 0.02
_SHARES = ("first", "total", "derivative")


@locked
def sensitivity(
    result: Optimum | xr.DataTree,
    quantity: Quantity,
    *,
    model: pm.Model | None = None,
    n_points: int = 1024,
    computed: bool = False,
    executor: Executor | None = None,
    store: StrPath | None = None,
    version: str | None = None,
    random_seed: Seed = 0,
) -> SensitivityTable:
    r"""Return Sobol' indices of a decision quantity, by hyperparameter and by input.

    The quantity Q is uncertain because the hyperparameters are. For each hyperparameter the table
    has the share of Q's variance that knowing it would remove on average (first order), :math:`S_i
    = Var(E[Q | \theta_i]) / Var(Q)`, the share that remains when all others are known (total
    order), :math:`T_i = E[Var(Q | \theta_{-i})] / Var(Q)`, and an upper bound of the total from
    derivatives. Evaluating Q costs weights and no response. For each aleatory input the table has
    the same shares of the response's variance in the population at the centre of the result. For an
    `Exceedance` or a `Quantile` they are shares of the variance of the indicator that a specimen is
    beyond.

    Hyperparameters depend on each other in the posterior. Their shares then need not sum to one,
    and the total may be smaller than the first order.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution; or with a ``posterior`` group, from any
        sampler.
    quantity : Quantity
        From ``prb.decision``, such as ``prb.decision.Quantile(response, x, probability=0.99)``.
        A response other than a simulator's is computed once for each run of the design, unless
        `predict` has computed it.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    n_points : int
        Number of populations for the indices of hyperparameters, and a quarter of the number of
        specimens for those of inputs.
    computed : bool
        Whether the indices of inputs come from calls of the response at new specimens,
        4 ``n_points`` times (1 + 2 inputs + 2 numbers of a specimen) of them; by default from
        emulators, or with one input from the runs.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    store : path-like, optional
        A folder that keeps every computed response, by its name.
    version : str, optional
        Of the response, for the store; as for `Reweighted`.
    random_seed : int, sequence of int, numpy.random.Generator or None

    Returns
    -------
    xarray.Dataset
        Dimension ``factor``, the elements of theta and the aleatory inputs, with ``kind``,
        "hyperparameter" or "input". Variables ``first``, ``total`` and ``derivative``, with their
        standard errors ``first_error``, ``total_error`` and ``derivative_error``, by points and
        draws: shares without a unit; NaN where they are not known, as derivatives of an indicator.
        Attributes: ``quantity``; ``of_inputs``, the number of a specimen whose variance is
        attributed to the inputs; in the quantity's units ``value``, that at the centre,
        ``value_error``, its standard error from points and emulator, and ``sd``, its standard
        deviation over the hyperparameters; ``scatter``, the aleatory share of
        the variance of a new specimen; ``responses``, the number computed; ``inputs``, the reason
        if indices of inputs are not known; ``findings`` (as JSON), such as that few responses
        are beyond the quantity; and ``identity``. It prints as sentences; a notebook shows a table.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses.
    DesignError
        If the design does not support the populations.
    ResponseError
        If the response raises, or has the wrong shape.

    Notes
    -----
    The posterior is approximated by a normal copula with its margins: draws of an element given the
    others are exact if it is normal in unconstrained parameters. The derivative-based index of an
    element is :math:`s_i^2 E[(dQ/dz_i)^2] / Var(Q)`, where z is the normal vector of the copula and
    s_i the standard deviation of z_i given all others. By Poincaré's inequality for that
    conditional distribution it is at least the total. An input that is a vector is one factor.

    References
    ----------
    .. [1] Saltelli, A. et al. (2010), Variance based sensitivity analysis of model output, Comput.
       Phys. Commun. 181, 259-270, doi:10.1016/j.cpc.2009.09.018.
    .. [2] Kucherenko, S., S. Tarantola and P. Annoni (2012), Estimation of global sensitivity
       indices for models with dependent variables, Comput. Phys. Commun. 183, 937-946,
       doi:10.1016/j.cpc.2011.12.020.
    .. [3] Sobol', I. M. and S. Kucherenko (2009), Derivative based global sensitivity measures and
       their link with global sensitivity indices, Math. Comput. Simul. 79, 3009-3017,
       doi:10.1016/j.matcom.2009.01.023.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1), name="x")
    ...     data = np.random.default_rng(1).normal(0, 1, 50)
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.ProbabilityResidual(), observed=data)
    >>> mean = prb.decision.Mean(np.sinh, x)
    >>> table = prb.sensitivity(prb.minimize(model), mean)
    >>> table.factor.values.tolist()
    ['mu', 'sigma', 'x']
    >>> bool(table.first.sel(factor="mu") > 0.9)
    True
    """
    caller = "prb.sensitivity"
    refuse_quantity(quantity, caller)
    n_points = positive_integer(n_points, "n_points", minimum=2 * REPLICATES)
    flag(computed, "computed")
    seed = seed_number(random_seed)
    # With 4000 draws margins and correlations have an error of two percent.
    populations = Populations.of(
        result, model, 4000, caller, call_settings(executor, store, version)
    )
    sample = populations.sample(quantity.response, quantity.inputs, quantity.output)
    findings, error = checked_by_family(sample, quantity)
    hyperparameters = _hyperparameter_indices(sample, quantity, n_points, seed)
    inputs, obstacle = input_indices(sample, quantity, n_points, seed, computed=computed)
    findings += report(*_constant_findings(hyperparameters, quantity))
    columns = {}
    for row, name in enumerate(_SHARES):
        values = [hyperparameters.values[row], inputs.values[row]]
        errors = [hyperparameters.errors[row], inputs.errors[row]]
        columns[name] = ("factor", np.concatenate(values))
        columns[f"{name}_error"] = ("factor", np.concatenate(errors))
    evaluator = populations.evaluator
    simulator = evaluator.simulators[sample.k]
    named = aleatory_names(simulator.inputs, simulator.responses.function)
    is_replaced = sample.design.inputs is not simulator.inputs
    factors = sample.responses.inputs if is_replaced else simulator.inputs
    places = [simulator.inputs.aleatory.index(x) for x in factors.aleatory]
    names = [named[place] for place in places]
    kinds = ["hyperparameter"] * evaluator.hyperparameters.size + ["input"] * len(names)
    return SensitivityTable(
        columns,
        coords={
            "factor": [*evaluator.hyperparameters.readable_names, *names],
            "kind": ("factor", kinds),
        },
        attrs={
            "quantity": repr(quantity),
            "value": float(sample.evaluate(quantity.of, populations.center[None])[0]),
            "value_error": error,
            "sd": standard_deviation(sample.evaluate(quantity.of, populations.thetas)),
            "of_inputs": quantity.of_inputs,
            "scatter": _aleatory_share(sample, quantity),
            "responses": sample.responses.count,
            "inputs": obstacle,
            "findings": as_json(findings),
            "random_seed": str(seed),
            **populations.provenance(),
        },
    )


class SensitivityTable(Table):
    """Shares of a variance by factor."""

    __slots__ = ()
    _parts = ("first", "total", "factor", "quantity", "value", "value_error", "sd")
    _columns = (
        *("first", "first_error", "total", "total_error"),
        *("derivative", "derivative_error"),
    )

    def to_view(self) -> View:
        """Return what a reader sees."""
        attrs, rows = self.attrs, []
        for factor in self["factor"].values:
            row = self.sel(factor=factor)
            numbers = [(float(row[key]), float(row[f"{key}_error"])) for key in _SHARES]
            cells = [f"{x:.2f} ± {error:.2f}" if np.isfinite(x) else "" for x, error in numbers]
            rows.append([str(factor), str(row["kind"].item()), *cells])
        sentences = sentences_of(attrs)
        if np.isinf(attrs["sd"]):
            sentences.append("The quantity is infinite at some draws, which the shares leave out.")
        if attrs["inputs"]:
            sentences.append(f"Inputs: {attrs['inputs']}.")
        sentences.append(
            f"Shares of inputs are those in the variance of {attrs['of_inputs']}; "
            f"{attrs['responses']} responses computed."
        )
        heading = (
            f"{attrs['quantity']}: {attrs['value']:.4g} at the centre, with a standard deviation "
            f"of {attrs['sd']:.2g} over the hyperparameters, and an error of the computation of "
            f"{attrs['value_error']:.1g}"
        )
        header = ["", "", "first-order share", "total share", "derivative bound"]
        return View(heading, header, rows, sentences)


@dataclass(frozen=True, eq=False)
class SensitivityIndices:
    """First-order, total-order and derivative-based indices of d factors."""

    values: Floats  # (3, d): indices
    errors: Floats  # (3, d): standard errors of the indices

    @classmethod
    def of_replicates(cls, indices: Floats) -> SensitivityIndices:
        """Return means and standard errors over r replicates, (d, 3, r)."""
        errors = np.std(indices, axis=-1, ddof=1) / np.sqrt(indices.shape[-1])
        return cls(np.mean(indices, axis=-1).T, errors.T)


def _paired_points(n: int, d: int, seed: int) -> ArrayPair:
    """Return two independent sets of n normal vectors by replicate, (r, n, d) each."""
    seeds = [seed + 7919 * r for r in range(REPLICATES)]
    points = np.array([sobol(n, 2 * d, s) for s in seeds])
    z = ndtri(points)
    return z[..., :d], z[..., d:]


def _hyperparameter_indices(
    sample: ResponseSample, quantity: Quantity, n_points: int, seed: int
) -> SensitivityIndices:
    """Return the indices of the elements of theta in the variance of the quantity."""
    draws = sample.populations.thetas
    d = sample.populations.evaluator.hyperparameters.size
    # Blocks of the draws have replicates of their own, whose scatter contains the error of draws.
    n_blocks = REPLICATES // 2 if len(draws) >= 1000 else 1
    copulas = [Copula.of(block) for block in np.array_split(draws, n_blocks)]
    points = _paired_points(n_points // REPLICATES, d, seed)
    first, second = (np.split(normal, n_blocks) for normal in points)
    z = [normal @ copula.root.T for copula, normal in zip(copulas, first, strict=True)]
    independent = [normal @ copula.root.T for copula, normal in zip(copulas, second, strict=True)]
    blocks = list(zip(copulas, z, independent, second, strict=True))

    def evaluate(vectors: Sequence[Floats]) -> Floats:
        pairs = zip(copulas, vectors, strict=True)
        thetas = np.concatenate([copula.thetas(z) for copula, z in pairs])
        return sample.evaluate(quantity.of, thetas.reshape(-1, d)).reshape(thetas.shape[:-1])

    values, unrelated = evaluate(z), evaluate(independent)
    infinite = 1 - np.isfinite(values).mean()
    if infinite > 0.01:  # because shares have an error of a hundredth anyway
        raise ValueError(
            f"prb.sensitivity: {quantity!r}: got no finite number in {infinite:.1%} of the "
            "populations, expected one in all but 1%; where specimens fail, ask for a smaller "
            "probability, or an Exceedance"
        )
    values = finite_or_nan(values)
    indices = []
    sds = np.repeat([c.conditional_sd for c in copulas], REPLICATES // n_blocks, axis=0)
    for i, step in enumerate(np.eye(d) * _STEP / 2):
        same_element = evaluate([c.rest_given_element(x, w, i) for c, x, w, _ in blocks])
        same_rest = evaluate([c.element_given_rest(x, normal, i) for c, x, _, normal in blocks])
        slopes = (evaluate([x + step for x in z]) - evaluate([x - step for x in z])) / _STEP
        indices.append(
            [
                first_order(values, same_element, unrelated),
                total_order(values, same_rest),
                derivative_bound((sds[:, i, None] * slopes) ** 2, values),
            ]
        )
    by_block = np.array(indices)
    if n_blocks > 1:
        by_block = by_block.reshape(d, 3, n_blocks, -1).mean(axis=-1)
    result = SensitivityIndices.of_replicates(by_block)
    # The square of a correlation of m independent draws has the mean 1 / m.
    return replace(result, errors=np.hypot(result.errors, n_blocks / len(draws)))


def input_indices(
    sample: ResponseSample, quantity: Quantity, n_points: int, seed: int, *, computed: bool
) -> tuple[SensitivityIndices, str]:
    """Return the indices of the inputs at the central population, and why they are not known.

    Inputs are independent. The errors include that of the emulator, from emulators without a block
    of runs.
    """
    center = sample.populations.center[None]
    unknown = SensitivityIndices(*np.full((2, 3, len(sample.design.inputs.aleatory)), np.nan))
    try:
        transform = InverseTransform(
            sample.responses.name, sample.design.inputs, sample.parents(center)
        )
    except TypeError as error:
        return unknown, str(error)
    d = transform.size
    # Inputs get four times as many points as hyperparameters, because an emulator is cheaper than
    # weights of a design.
    first, second = _paired_points(4 * n_points // REPLICATES, d, seed)
    same_input, same_rest, neighbours = [], [], []
    for columns in transform.columns:
        is_input = np.isin(np.arange(d), np.arange(d)[columns])
        same_input.append(np.where(is_input, first, second))
        same_rest.append(np.where(is_input, second, first))
    for step in np.eye(d) * _STEP / 2:
        neighbours += [first + step, first - step]
    z = np.array([first, *same_input, *same_rest, *neighbours])
    outputs = _responses_at(sample, transform, z.reshape(-1, d), computed=computed)
    if not outputs:
        reason = "the response is not known between the runs; computed=True calls it at new ones"
        return unknown, reason
    (at,) = sample.evaluate(quantity.of, center)
    replicates = []
    for values in outputs:
        numbers = quantity.of_specimen(values, at).reshape(z.shape[:-1])
        replicates.append(_indices_of_matched(numbers, transform.columns))
    best, *resampled = (SensitivityIndices.of_replicates(indices) for indices in replicates)
    emulator_error = np.sum([(indices.values - best.values) ** 2 for indices in resampled], axis=0)
    is_known = np.array([[True], [True], [quantity.differentiable]])
    values = np.where(is_known, best.values, np.nan)
    errors = np.where(is_known, np.sqrt(best.errors**2 + emulator_error), np.nan)
    reason = ""
    if np.isnan(values[:2]).any():
        reason = (
            f"{quantity.of_inputs} is the same for all {first.shape[1]} specimens of a replicate, "
            "so that there is no variance to share; ask for a less rare quantity, or pass a "
            "larger n_points"
        )
    return SensitivityIndices(values, errors), reason


def _constant_findings(indices: SensitivityIndices, quantity: Quantity) -> Findings:
    """Return a finding if a quantity has no variance over the hyperparameters."""
    if not np.isnan(indices.values).any():
        return ()
    text = (
        f"{quantity!r} is the same in all populations of a replicate, so that there is no variance "
        "to share between hyperparameters; ask for another quantity, or pass a larger n_points."
    )
    return (Finding("constant-quantity", text),)


def _indices_of_matched(numbers: Floats, columns: list[slice]) -> Floats:
    """Return the indices of inputs by replicate, (inputs, 3, r), at the points of `input_indices`.

    The rows of ``numbers`` are the points, those with the same input, those with the same rest,
    and pairs of neighbours.
    """
    n = len(columns)
    (base,), same_input, same_rest, neighbours = np.split(numbers, 1 + n * np.arange(3), axis=0)
    slopes = (neighbours[::2] - neighbours[1::2]) / _STEP
    return np.array(
        [
            [
                first_order(base, same_input[i]),
                total_order(base, same_rest[i]),
                derivative_bound((slopes[own_columns] ** 2).sum(axis=0), base),
            ]
            for i, own_columns in enumerate(columns)
        ]
    )


def _responses_at(
    sample: ResponseSample, transform: InverseTransform, z: Floats, *, computed: bool
) -> list[Floats]:
    """Return the response at normal vectors, (N,), and of emulators without a block of runs."""
    if computed:
        return [sample.select(transform.responses(sample.responses, z))]
    x = transform(z)
    if not sample.design.on_line:
        return sample.emulated(x)
    # With one input interpolate between the runs, and return the response of the nearest run where
    # that is not finite.
    (runs,) = sample.points
    values = sample.select(sample.outputs)
    order = np.argsort(runs)
    runs, values = runs[order], values[order]
    is_finite = np.isfinite(values)
    interpolated = np.interp(x[0], runs[is_finite], values[is_finite])
    nearest = values[np.searchsorted((runs[1:] + runs[:-1]) / 2, x[0])]
    return [np.where(np.isfinite(nearest), interpolated, nearest)]


def _aleatory_share(sample: ResponseSample, quantity: Quantity) -> float:
    """Return the share of a new specimen's variance that is within populations."""
    (at,) = sample.evaluate(quantity.of, sample.populations.center[None])
    numbers = quantity.of_specimen(sample.values, at)
    if not np.isfinite(numbers).all():
        return np.nan
    weights = sample.weights(sample.populations.thinned())
    deviation = numbers - numbers.mean()
    means = weights @ deviation
    within = np.nanmean(weights @ deviation**2 - means**2)
    total = within + np.nanvar(means)
    return float(within / total) if total > 0 else np.nan


def first_order(values: Floats, same: Floats, independent: Floats | None = None) -> Floats:
    r"""Return the first-order index of a factor by replicate, (r,).

    :math:`S_i = Var(E[Y | X_i]) / Var(Y) = Corr(Y, Y')`, equation 6 of Janon et al. (2014),
    Asymptotic normality and efficiency of two Sobol index estimators, doi:10.1051/ps/2013040.
    ``same`` are values at other points with the same X_i, (r, n); pairs with NaN are left out.
    ``independent`` are values at these points with another X_i. Their correlation with Y is zero,
    and removes the noise of the points (a control variate): all of it for a factor without effect.
    """
    result = _row_correlation(values, same)
    if independent is not None:
        # One coefficient of all replicates, because its noise times that of the other is a bias.
        coefficient = np.mean(_row_correlation(same, independent))
        result = result - coefficient * _row_correlation(values, independent)
    return result


def _row_correlation(a: Floats, b: Floats) -> Floats:
    """Return the correlation of two variables with the same distribution, (r, n) -> (r,)."""
    a, b = _complete_pairs(a, b)
    mean = np.nanmean(a + b, axis=1, keepdims=True) / 2
    covariance = np.nanmean((a - mean) * (b - mean), axis=1)
    variance = np.nanmean((a - mean) ** 2 + (b - mean) ** 2, axis=1) / 2
    return _ratio(covariance, variance)


def total_order(values: Floats, other: Floats) -> Floats:
    r"""Return the total-order index of a factor by replicate, (r,).

    :math:`T_i = E[Var(Y | X_{-i})] / Var(Y) = E[(Y - Y')^2] / (2 Var(Y))`, after Jansen (1999),
    doi:10.1016/S0010-4655(98)00154-4. ``other`` are values where X_i alone differs, drawn given
    all others, (r, n).
    """
    values, other = _complete_pairs(values, other)
    part = np.nanmean((values - other) ** 2, axis=1) / 2
    variance = (np.nanvar(values, axis=1) + np.nanvar(other, axis=1)) / 2
    return _ratio(part, variance)


def derivative_bound(squares: Floats, values: Floats) -> Floats:
    r"""Return Poincaré's bound of the total index of a standard normal factor, (r,).

    :math:`T_i \le E[(dY / dz_i)^2] / Var(Y)`, with equality where Y is linear in z_i (Sobol' and
    Kucherenko 2009, doi:10.1016/j.matcom.2009.01.023). ``squares`` are squared derivatives, (r, n).
    """
    return _ratio(np.nanmean(squares, axis=1), np.nanvar(values, axis=1))


def _complete_pairs(a: Floats, b: Floats) -> ArrayPair:
    """Return two arrays, NaN where either is not finite."""
    is_complete = np.isfinite(a) & np.isfinite(b)
    return np.where(is_complete, a, np.nan), np.where(is_complete, b, np.nan)


def _ratio(part: Floats, variance: Floats) -> Floats:
    """Return a share of a variance, NaN if the variance is zero."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(variance > 0, part / variance, np.nan)


# Normal scores of the quantiles between which a margin is linear. Variances of a normal margin are
# then accurate to half a percent. Closer quantiles would follow the noise of 4000 draws.
_SCORES = np.linspace(-2.75, 2.75, 23)


@dataclass(frozen=True, eq=False)
class Copula:
    """Theta as a monotone function of each element of a normal vector z."""

    quantiles: Floats  # (q, d): quantiles of each element at `_SCORES`, extrapolated linearly
    correlation: Floats  # (d, d): correlation of z

    @classmethod
    def of(cls, thetas: Floats) -> Copula:
        """Fit draws, (k, d): margins by quantiles, correlation by normal scores."""
        quantiles = np.quantile(thetas, ndtr(_SCORES), axis=0)
        scores = ndtri((rankdata(thetas, axis=0) - 0.5) / len(thetas))
        d = thetas.shape[1]
        return cls(quantiles, np.corrcoef(scores, rowvar=False).reshape(d, d))

    def thetas(self, z: Floats) -> Floats:
        """Return the thetas of normal vectors, (..., d)."""
        step = _SCORES[1] - _SCORES[0]
        position = (z - _SCORES[0]) / step
        last = len(_SCORES) - 2
        below = np.clip(np.floor(position), 0, last).astype(int)
        columns = np.arange(z.shape[-1])
        low = self.quantiles[below, columns]
        high = self.quantiles[below + 1, columns]
        fraction = position - below
        return np.asarray(low + fraction * (high - low))

    @cached_property
    def root(self) -> Floats:
        """The lower Cholesky factor of the correlation, (d, d)."""
        return np.linalg.cholesky(self.correlation)

    @cached_property
    def _precision(self) -> Floats:
        return np.linalg.inv(self.correlation)

    @cached_property
    def conditional_sd(self) -> Floats:
        """The standard deviation of each element of z given all others, (d,)."""
        return 1 / np.sqrt(np.diag(self._precision))

    def element_given_rest(self, z: Floats, normal: Floats, i: int) -> Floats:
        """Return z with a new i-th element given the rest, from independent normals (..., d)."""
        sd = self.conditional_sd[i]
        mean = z[..., i] - (z @ self._precision[:, i]) * sd**2
        result = z.copy()
        result[..., i] = mean + sd * normal[..., i]
        return result

    def rest_given_element(self, z: Floats, independent: Floats, i: int) -> Floats:
        """Return the i-th element of z with a new rest, from an independent draw of z (..., d)."""
        shift = z[..., i] - independent[..., i]
        return independent + shift[..., None] * self.correlation[:, i]
