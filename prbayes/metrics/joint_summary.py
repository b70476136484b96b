r"""The likelihood of the statistics of several outputs of the same n specimens.

The statistics of each output have their own likelihood, and normal scores z by it
(`summary_likelihood`). Statistics of different outputs are correlated, because they are those of
the same specimens. A Gaussian copula joins the scores:

.. math:: \log p = \sum_k \log p_k + \log N(z; 0, R) - \log N(z; 0, I).                    (1)

R follows from the influences of a specimen on the statistics, the response, its square, and whether
it is above an order statistic: L is the Cholesky factor of their covariance C within outputs, and
:math:`R = L^{-1} C L^{-T}`. For a normal population the means then have their exact law, and the
sums of squares W the correlation of a Wishart matrix, the squared one of the outputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, ClassVar, Self

import numpy as np

from prbayes._validate import AT_ONCE, Bools, Floats, Indices, Names, called
from prbayes.metrics.base import Basis, DenseBasis, Discrepancy, Features, Metric, Minimum
from prbayes.metrics.summary import Summary
from prbayes.metrics.summary_likelihood import (
    SummaryDiscrepancy,
    SummaryLikelihood,
    has_response,
    statistics_text,
)


def has_data_sheets(observed: Any) -> bool:
    """Return whether observed values are a data sheet, or a mapping with one."""
    values = observed.values() if isinstance(observed, Mapping) else [observed]
    return any(isinstance(value, Summary) for value in values)


def read_sheets(name: str, observed: Any) -> tuple[Metric, Any]:
    """Return the metric and the values of a data sheet, or of a mapping of them by output."""
    if isinstance(observed, Summary):
        return SummaryLikelihood(observed), observed.values
    specimens = [key for key, sheet in observed.items() if not isinstance(sheet, Summary)]
    if specimens:
        key = specimens[0]
        raise TypeError(
            f"{name}: observed[{key!r:.60}]: got {called(observed[key])} beside a "
            "prb.Summary, expected a Summary of each output; write a simulator for the outputs "
            "whose specimens are known"
        )
    sizes = {key: sheet.n for key, sheet in observed.items()}
    if len(set(sizes.values())) > 1:
        raise ValueError(
            f"{name}: observed: got n = {sizes!s:.100}, expected one number of specimens, since a "
            "mapping has outputs of the same ones; write a simulator for each data sheet of others"
        )
    sheets = tuple(observed.values())
    metric = JointSummaryLikelihood(tuple(map(str, observed)), sheets)
    return metric, dict(zip(observed, values_of_sheets(sheets).T, strict=True))


def values_of_sheets(sheets: tuple[Summary, ...]) -> Floats:
    """Return the values of several sheets, (statistics, m), with NaN after those of short ones."""
    return _padded([sheet.values for sheet in sheets])


def _padded(columns: list[Floats]) -> Floats:
    """Stack columns (..., s) of different lengths, with NaN at their ends, to (..., s, m)."""
    longest = max(column.shape[-1] for column in columns)
    result = np.full((*columns[0].shape[:-1], longest, len(columns)), np.nan)
    for k, column in enumerate(columns):
        result[..., : column.shape[-1], k] = column
    return result


@dataclass(frozen=True)
class JointSummaryLikelihood(Metric):
    """Minus the mean log-likelihood of several `Summary` of the same specimens, by specimen.

    Parameters
    ----------
    names : tuple of str
        Names of the outputs.
    sheets : tuple of Summary
        A sheet of each output, of the same number of specimens.
    rounding : float
        Variance of the statistics' rounding, relative to their sampling variance. It bounds the
        correlation of outputs that are functions of each other: sheets have two or three digits.
    """

    names: Names
    sheets: tuple[Summary, ...]
    rounding: float = 1e-3
    minimum: ClassVar[Minimum] = Minimum.QUADRATIC
    likelihood: ClassVar[bool] = True
    distance: ClassVar[bool] = False
    exact_likelihood: ClassVar[bool] = True
    takes_outputs: ClassVar[bool] = True
    additive = False

    def __post_init__(self) -> None:
        most = max(SummaryLikelihood(sheet).tail_responses for sheet in self.sheets)
        object.__setattr__(self, "tail_responses", most)

    @property
    def data_sheet(self) -> str:
        """The statistics of each output as text."""
        pairs = zip(self.names, self.sheets, strict=True)
        return "; ".join(f"{name}: {statistics_text(sheet)}" for name, sheet in pairs)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        values = values_of_sheets(self.sheets)
        if not np.array_equal(observed, values, equal_nan=True):
            raise ValueError(
                f"observed: got an array of shape {observed.shape}, expected the values of the "
                "mapping of Summary that the simulator was made with, which has no single "
                "specimens; build the model again with other data sheets"
            )
        members = []
        for sheet in self.sheets:
            member = SummaryLikelihood(sheet).against(sheet.values)
            assert isinstance(member, SummaryDiscrepancy)
            members.append(member)
        return JointSummaryDiscrepancy(self, observed, weights, tuple(members), self.rounding)


@dataclass(frozen=True, eq=False)
class JointSummaryDiscrepancy(Discrepancy):
    """Minus log-likelihood over n. Features are those of the outputs, and products of influences.

    Attributes
    ----------
    members : tuple of SummaryDiscrepancy
        One for each output.
    rounding : float
        Relative variance by which correlations between outputs are bounded.
    """

    members: tuple[SummaryDiscrepancy, ...]
    rounding: float

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same discrepancy: there are no specimens that others could replace."""
        return self

    def rows(self, index: Any) -> Self:
        """Return the same discrepancy, that of the only data set."""
        return self

    @property
    def n_effective(self) -> float:
        """The number of specimens."""
        return self.members[0].n_effective

    def replicate(self, specimens: Floats) -> Floats:
        """Return the same statistics of other specimens, (..., n, m) -> (..., statistics, m)."""
        return _padded([x.replicate(specimens[..., k]) for k, x in enumerate(self.members)])

    @property
    def scale(self) -> float:
        """One: a log-likelihood has no units."""
        return 1.0

    def _columns(self, simulated: Any, xp: Any) -> list[Any]:
        """Return the features of single responses, (..., n) each: members first, then products."""
        is_known = has_response(simulated, xp).all(axis=-1)
        columns, influences = [], [xp.where(is_known, 1.0, 0.0)]
        for k, member in enumerate(self.members):
            output = simulated[..., k]
            y = xp.where(is_known, output, np.nan)
            columns += member.columns(y, xp)
            terms = member.influences(y, xp)
            influences += [xp.where(is_known, term, 0.0) for term in terms]
        return columns + [a * b for a, b in combinations_with_replacement(influences, 2)]

    @cached_property
    def _sizes(self) -> tuple[list[int], list[int]]:
        """Numbers of features and of influences of each member."""
        point = np.zeros(1)
        pairs = [(m.columns(point, np), m.influences(point, np)) for m in self.members]
        return [len(columns) for columns, _ in pairs], [len(terms) for _, terms in pairs]

    @cached_property
    def _reference(self) -> Floats:
        """The features of independent normal outputs with centers and units of the sheets."""
        rng = np.random.default_rng(0)
        summaries = [member.summary for member in self.members]
        score = rng.standard_normal((1024, len(summaries)))
        units = [summary.unit or abs(summary.center) or 1.0 for summary in summaries]
        centers = [summary.center for summary in summaries]
        columns = self._columns(centers + units * score, np)
        return np.array([np.mean(column) for column in columns])

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the features, (..., m)."""
        sums = [(weights * column).sum(axis=-1) for column in self._columns(simulated, xp)]
        return (xp.stack(sums, axis=-1),)

    def basis(self, simulated: Floats, most: float = AT_ONCE) -> Basis:
        """Return the matrix of the features of the responses, (n, m)."""
        return DenseBasis((np.stack(self._columns(simulated, np), axis=-1),))

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return minus the log-likelihood over n."""
        (sums,) = features
        sizes, counts = self._sizes
        log_l = 0.0
        scores = []
        start = 0
        for member, size in zip(self.members, sizes, strict=True):
            of_member = sums[..., start : start + size]
            log_p, z = member.log_density(of_member, xp)
            log_l = log_l + log_p
            scores += z
            start += size
        products = sums[..., start:]
        total = xp.maximum(products[..., 0], 1e-300)
        shares = products / total[..., None]
        reference = self._reference[start:]
        products = (1 - 1e-9) * shares + 1e-9 * reference
        output = np.repeat(np.arange(len(counts)), counts)
        within = output[:, None] == output
        log_l = log_l + self._log_copula(products, scores, within, xp)
        return -log_l / self.members[0].summary.n

    def _log_copula(self, products: Any, scores: list[Any], within: Bools, xp: Any) -> Any:
        """Return the logarithm of the copula's density, log N(z; 0, R) - log N(z; 0, I) of (1).

        ``within`` marks the pairs of influences of the same output.
        """
        second = products[..., _symmetric(within.shape[0] + 1)]
        mean = second[..., 0, 1:]
        covariance = second[..., 1:, 1:] - _outer(mean)
        variance = xp.maximum(_diagonal(covariance, xp), 1e-12)
        deviation = xp.sqrt(variance)
        correlation = covariance / _outer(deviation)
        correlation = correlation + 1e-6 * np.eye(len(within))
        shrinkage = np.where(within, 1.0, 1.0 - self.rounding)
        factor = _triangular(correlation * within, xp)
        joint = _triangular(correlation * shrinkage, xp)
        z = xp.stack(scores, axis=-1)
        correlated = (factor * z[..., None, :]).sum(axis=-1)
        residuals = _solved(joint, correlated, xp)
        ratio = _diagonal(joint, xp) / _diagonal(factor, xp)
        gain = 0.5 * (z**2 - residuals**2)
        log_c = gain - xp.log(ratio)
        return log_c.sum(axis=-1)


def _symmetric(size: int) -> Indices:
    """Return the index of each pair among combinations with replacement, (size, size)."""
    result = np.zeros((size, size), dtype=np.intp)
    for k, (i, j) in enumerate(combinations_with_replacement(range(size), 2)):
        result[i, j] = result[j, i] = k
    return result


def _outer(x: Any) -> Any:
    """Return products of the elements of vectors, (..., q) -> (..., q, q)."""
    rows = x[..., :, None]
    columns = x[..., None, :]
    return rows * columns


def _diagonal(matrix: Any, xp: Any) -> Any:
    """Return the diagonals of matrices, (..., q)."""
    return xp.diagonal(matrix, axis1=-2, axis2=-1)


def _triangular(matrix: Any, xp: Any) -> Any:
    """Return the lower triangular factors of matrices, (..., q, q).

    In NumPy one matrix that rounding makes indefinite does not concern the others.
    """
    if xp is not np:
        return xp.linalg.cholesky(matrix, lower=True, on_error="nan")
    size = matrix.shape[-1]
    factor = np.zeros_like(matrix)
    for i in range(size):
        positive = np.maximum(matrix[..., i, i], 1e-9)
        pivot = np.sqrt(positive)
        column = matrix[..., i:, i] / pivot[..., None]
        factor[..., i:, i] = column
        factor[..., i, i] = pivot
        matrix = matrix - _outer(factor[..., i])
    return factor


def _solved(factor: Any, values: Any, xp: Any) -> Any:
    """Return solutions (..., q) of lower triangular systems."""
    if xp is not np:
        return xp.linalg.solve_triangular(factor, values, lower=True, b_ndim=1)
    return np.linalg.solve(factor, values[..., None])[..., 0]
