"""Null distributions of the area test.

The predicted population is taken as exact (`ExactModel`), uncertain (`PosteriorNull`), or fitted
to the tested specimens themselves (`JointNull`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cache, partial
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np

from prbayes._progress import progress
from prbayes._stats import ENVELOPED, envelope
from prbayes._validate import (
    AT_ONCE,
    ArrayPair,
    Floats,
    Indices,
    StrPath,
    positive_integer,
    positive_number,
    share,
    wrong_value,
)
from prbayes.inference.refits import SamplingDistribution, refit
from prbayes.inference.resampling import groups, sets_at, simulated_points
from prbayes.model.evaluator import read_inputs_of_copy, shortcomings
from prbayes.model.fingerprint import Level, require_same
from prbayes.model.random_variable import Node
from prbayes.model.simulator_with_data import number_specimens
from prbayes.optimize.optimum import Optimum, require_refits
from prbayes.propagation.base import DesignError
from prbayes.propagation.design import PoorEmulatorError
from prbayes.propagation.reweighted import designs_restored
from prbayes.response.response import Responses, refuse_uncallable
from prbayes.results.predict import call_settings, data_digest, in_order, serving, specimen_names
from prbayes.validation.pit import Case, Predictive, TestedCondition, between

# The fewest replicates that can reject at 5%: p is at least 1 / 20.
LEAST_REPLICATES = 19


@dataclass(frozen=True, eq=False)
class Judgement:
    """p-value and critical value, and a function that returns the envelope of sorted values."""

    p_value: float
    critical_value: float
    envelope: Callable[[], ArrayPair]  # lower and upper bounds, (n,)


class Null(ABC):
    """A null distribution: `ExactModel`, `PosteriorNull` or `JointNull`."""

    own_specimens: ClassVar[bool] = False  # whether the calibration's own specimens may be tested
    description: ClassVar[str] = ""

    @abstractmethod
    def judge(self, case: Case, statistic: float, alpha: float) -> Judgement:
        """Return p-value, critical value and envelope."""

    def describe(self, case: Case) -> str:
        """Return the null hypothesis in a phrase."""
        return self.description


def judge_by_replicates(
    replicates: Iterable[Floats], case: Case, statistic: float, alpha: float
) -> Judgement:
    r"""Compare the observed statistic with those of replicates, blocks of u-values (r, n).

    .. math:: p = (1 + \#\{A_r \ge A\}) / (1 + r)
    """
    enveloped = None
    blocks = []
    with progress("replicates") as report:
        for u in replicates:
            tested = case.tested(u)
            if enveloped is None:
                enveloped = tested[:ENVELOPED]
            blocks.append(case.statistic(u))
            report(len(tested), "")
    assert enveloped is not None
    areas = np.sort(np.concatenate(blocks))
    total = areas.size + 1
    # Number of replicates that may be as large in a rejection. The small number is there because
    # .05 * 20 may be rounded to less than one.
    allowed = int(np.floor(alpha * total + 1e-9)) - 1
    if allowed < 0:
        raise ValueError(
            f"alpha: got {alpha} with {areas.size} replicates, expected at least "
            f"1 / ({areas.size} + 1); pass a null with more replicates"
        )
    # The factor counts ties that differ by rounding.
    n_as_large = np.sum(areas >= statistic * (1 - 1e-12))
    return Judgement(
        p_value=float((1 + n_as_large) / total),
        critical_value=float(areas[areas.size - allowed - 1]),
        envelope=partial(envelope, enveloped, alpha),
    )


@dataclass(frozen=True)
class PosteriorNull(Null):
    """The specimens come from one unknown population of the posterior.

    u-values are taken in the pool of all populations.

    Each replicate takes one draw of the posterior, the same under all conditions, and all its
    values from that population; a specimen that was measured several times is one sample.
    Replicates drawn value by value from the pool would be as narrow as if the model were exact.

    Parameters
    ----------
    replicates : int
        Number of data sets.
    random_seed : int

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> PosteriorNull(1999)
    PosteriorNull(replicates=1999, random_seed=0)
    """

    replicates: int = 9999
    _: KW_ONLY
    random_seed: int = 0

    def __post_init__(self) -> None:
        positive_integer(self.replicates, "PosteriorNull: replicates", minimum=LEAST_REPLICATES)
        positive_integer(self.random_seed, "PosteriorNull: random_seed", minimum=0)

    def judge(self, case: Case, statistic: float, alpha: float) -> Judgement:
        """Count the observed data among the replicates."""
        return judge_by_replicates(self.replicates_of(case), case, statistic, alpha)

    def replicates_of(self, case: Case) -> Iterator[Floats]:
        """Draw u-values of replicates, in blocks of shapes (r, n)."""
        rng = np.random.default_rng(self.random_seed)
        rng_of_ties = case.rng(1)
        # For each condition arrays (D, S): whether a sample has a response, and its P(Y < y) and
        # P(Y <= y) in the pool of all draws.
        usable = [~np.isnan(c.predicted) for c in case.conditions]
        if case.shares_specimens:
            # A shared specimen needs a response under all conditions.
            usable = [np.logical_and.reduce(usable)] * len(usable)
        steps = [Predictive(c.predicted).steps(c.predicted) for c in case.conditions]
        # Order of the samples of each draw, those with a response first, and the number of these.
        orders = [np.argsort(~is_usable, axis=1, kind="stable") for is_usable in usable]
        counts = [np.count_nonzero(is_usable, axis=1) for is_usable in usable]
        draws = np.flatnonzero(np.min(counts, axis=0) > 0)
        if not draws.size:
            raise ValueError(
                "predicted: got NaN in every draw, expected specimens whose responses are numbers"
            )
        # Use every draw of the posterior equally often, in random order.
        draw_of = rng.permutation(draws[np.arange(self.replicates) % draws.size])
        # All blocks use one generator, so that results depend on the size of the blocks.
        step = max(1, AT_ONCE // (4 * case.size))
        for start in range(0, self.replicates, step):
            draw = draw_of[start : start + step, None]
            # Place of a specimen in its population, from 0 to 1. It is the same under all
            # conditions, and selects the same sample, hence the same specimen.
            place = rng.random((draw.size, case.n_specimens))
            u = []
            by_condition = zip(case.conditions, steps, orders, counts, strict=True)
            for condition, (lower, upper), order, count in by_condition:
                rank = (place[:, condition.numbers] * count[draw]).astype(int)
                sample = order[draw, rank]
                u.append(between(lower[draw, sample], upper[draw, sample], rng_of_ties))
            yield np.concatenate(u, axis=1)

    def describe(self, case: Case) -> str:
        """Return the null hypothesis in a phrase."""
        source = "the predicted population"
        if case.n_draws > 1:
            source = f"one of {case.n_draws} populations of the posterior"
        repeated = ""
        if case.is_dependent:
            repeated = f", {case.n_specimens} specimens with {case.size} values in all"
        return f"all specimens come from {source}{repeated}"


@cache
def table() -> tuple[Floats, Floats, Floats]:
    """Return k sizes n, minus the logs of m tail probabilities, and quantiles of sqrt(n) A, (k, m).

    The table ships; ``benchmarks/area_null.py`` makes it.
    """
    with files(__package__).joinpath("area_null.csv").open(encoding="utf-8") as file:
        _, *header = file.readline().split(",")
        rows = np.loadtxt(file, delimiter=",")
    tails = np.array(header, dtype=np.float64)
    return rows[:, 0], -np.log(tails), rows[:, 1:]


def _area_quantiles(n: int) -> ArrayPair:
    """Return minus the logs of tail probabilities and the quantiles of sqrt(n) A, (m,) each."""
    sizes, logs, quantiles = table()
    place = -1 / np.sqrt(n)
    places = -1 / np.sqrt(sizes)
    at_n = [np.interp(place, places, column) for column in quantiles.T]
    return logs, np.array(at_n)


def _slope(logs: Floats, quantiles: Floats) -> float:
    """Return the slope of minus the log tail probability in the square of a far quantile.

    Far out the relation is linear (Brownian bridge: exp(-6 x^2)). From n = 20 on, slopes by any of
    the last twelve quantiles agree within 5%.
    """
    return float((logs[-1] - logs[-8]) / (quantiles[-1] ** 2 - quantiles[-8] ** 2))


def uniform_envelope(n: int, alpha: float) -> ArrayPair:
    """Return the envelope of n sorted uniform numbers, (n,) each.

    For many numbers it is simulated at 2000 ranks, which are closer together near the ends, and
    interpolated. Gaps between uniform order statistics are Gamma variables over their sum.
    """
    rng = np.random.default_rng(0)
    places = np.sin(np.linspace(0, np.pi / 2, 2000)) ** 2
    ranks = np.unique(np.rint(1 + (n - 1) * places))
    if n <= 2 * places.size:
        return envelope(rng.random((ENVELOPED, n)), alpha)
    steps = np.diff(ranks, prepend=0, append=n + 1)
    ends = np.cumsum(rng.standard_gamma(steps, (ENVELOPED, steps.size)), axis=1)
    lower, upper = envelope(ends[:, :-1] / ends[:, -1:], alpha)
    numbers = np.arange(1, n + 1)
    return np.interp(numbers, ranks, lower), np.interp(numbers, ranks, upper)


@dataclass(frozen=True)
class ExactModel(Null):
    """The predicted population is taken as exact.

    u-values of a right model are then independent and uniform.

    The distribution of the area is exact for n = 1 to 20, interpolated in 1/sqrt(n) from exact ones
    up to 1000, and that of 1000, scaled, beyond. The table is made by ``benchmarks/area_null.py``.
    Tied values, such as rounded readings, do not have uniform u-values unless these are
    randomized. Their distribution is that of 9999 samples of the predicted population.
    If the model was fitted to data, this test rejects a right model too often: with 15 of them and
    20 fresh ones in 21% of cases at nominal 5%.

    Examples
    --------
    >>> import prbayes as prb
    >>> round(prb.validation.ExactModel().critical_value(20), 4)
    0.1298
    """

    description: ClassVar[str] = (
        "the predicted population is exact (the uncertainty of its calibration is not counted)"
    )

    def critical_value(self, n: int, alpha: float = 0.05) -> float:
        """Return the area that is exceeded with probability ``alpha`` by n uniform numbers."""
        n = positive_integer(n, "n")
        alpha = share(alpha, "alpha")
        log, (logs, quantiles) = -np.log(alpha), _area_quantiles(n)
        scaled = np.interp(log, logs, quantiles)
        if log > logs[-1]:
            scaled = np.sqrt(quantiles[-1] ** 2 + (log - logs[-1]) / _slope(logs, quantiles))
        return float(min(scaled / np.sqrt(n), 0.5))

    def p_value(self, statistic: float, n: int) -> float:
        """Return the probability that n uniform numbers have a larger area."""
        n = positive_integer(n, "n")
        if statistic != 0:
            positive_number(statistic, "statistic")
        scaled = np.sqrt(n) * statistic
        logs, quantiles = _area_quantiles(n)
        if scaled <= quantiles[-1]:
            return float(np.exp(-np.interp(scaled, quantiles, logs)))
        farther = scaled**2 - quantiles[-1] ** 2
        return float(np.exp(-(logs[-1] + _slope(logs, quantiles) * farther)))

    def judge(self, case: Case, statistic: float, alpha: float) -> Judgement:
        """Look up p-value and critical value, simulate the envelope; with ties simulate all."""
        if case.is_dependent:
            raise ValueError(
                f"null: got ExactModel() for {case.size} values of {case.n_specimens} specimens, "
                "expected one value per specimen; use prb.validation.PosteriorNull(), which passes "
                "each specimen through all conditions"
            )
        for condition in case.conditions:
            n_predicted = condition.predicted.size
            n_observed = condition.observed.size
            # A pool of m times as many values adds 1 / m to the variance of an ECDF. With a tenth,
            # a test at 5% rejects in some 6% of cases.
            if n_predicted < 10 * n_observed:
                raise ValueError(
                    f"{condition.name}: predicted: got {n_predicted} values for {n_observed} "
                    "observed ones, expected at least 10 times as many, so that the population is "
                    "known exactly; pass a larger n_samples"
                )
        if case.has_ties:
            conditions = [replace(c, predicted=c.predicted.reshape(1, -1)) for c in case.conditions]
            pooled = replace(case, conditions=tuple(conditions))
            replicates = PosteriorNull().replicates_of(pooled)
            return judge_by_replicates(replicates, pooled, statistic, alpha)
        return Judgement(
            p_value=self.p_value(statistic, case.size),
            critical_value=self.critical_value(case.size, alpha),
            envelope=partial(uniform_envelope, case.size, alpha),
        )


@dataclass(frozen=True)
class JointNull(Null):
    """Calibration and test data come together from the calibrated model.

    The model is recalibrated in each replicate.

    For tests on the specimens of the calibration, under the same conditions or others. A model
    follows specimens that it was fitted to more closely than fresh ones. Each replicate draws
    specimens from the population at the optimum, minimises the discrepancy for their calibration
    data, and tests their responses against that population. The predicted population is that of
    `predict` with the optimum. Minimisations are those of the parametric `bootstrap`: with
    `Reweighted` they compute no response.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`, without the prior.
    responses : tuple or mapping, optional
        ``(response, *inputs)`` of the tested condition, or such tuples by the names of conditions,
        as passed to `predict`. Conditions without one are the model's simulators, by name; a single
        condition is the only simulator.
    replicates : int
        Number of data sets.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    store : path-like, optional
        A folder that keeps every computed response, by its name.
    version : str, optional
        Of the response, for the store; as for `Reweighted`.
    random_seed : int

    Raises
    ------
    TypeError
        If ``optimum`` is no Optimum, or a response cannot be called.
    ValueError
        If a metric or propagation does not allow refits (the log-likelihood by specimen, `Fresh`,
        or a `FunctionMetric` without `Reweighted`); if the prior was part of the optimum, or its
        model has changed since.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> data = [0.1, 1.2, 2.0, 2.9, 4.2]
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=data)
    >>> optimum = prb.minimize(model)
    >>> predicted = prb.predict(optimum, np.positive, x, random_seed=1)
    >>> null = prb.validation.JointNull(optimum, replicates=199)
    >>> prb.area_test(data, predicted, null=null).rejected
    False
    """

    own_specimens: ClassVar[bool] = True
    description: ClassVar[str] = (
        "calibration and test data come from the calibrated model, which is recalibrated in each "
        "replicate"
    )

    optimum: Optimum = field(repr=False)
    _: KW_ONLY
    responses: tuple[Any, ...] | Mapping[str, tuple[Any, ...]] | None = field(
        default=None, repr=False
    )
    replicates: int = 999
    executor: Executor | None = field(default=None, repr=False)
    store: StrPath | None = field(default=None, repr=False)
    version: str | None = field(default=None, repr=False)
    random_seed: int = 0

    def __post_init__(self) -> None:
        call_settings(self.executor, self.store, self.version)
        advice = (
            "; the model cannot be recalibrated: test other specimens with "
            "prb.validation.PosteriorNull(), or hold these out by prb.cross_validate"
        )
        require_refits(self.optimum, "JointNull", advice)
        if self.responses is not None:
            tested = [self.responses]
            if isinstance(self.responses, Mapping):
                tested = list(self.responses.values())
            if not tested or not all(isinstance(t, tuple) and t and callable(t[0]) for t in tested):
                raise wrong_value(
                    self.responses,
                    "JointNull: responses",
                    "a tuple (response, *inputs), or a mapping of conditions to such",
                )
        positive_integer(self.replicates, "JointNull: replicates", minimum=LEAST_REPLICATES)
        positive_integer(self.random_seed, "JointNull: random_seed", minimum=0)

    def judge(self, case: Case, statistic: float, alpha: float) -> Judgement:
        """Count the observed data among the replicates."""
        return judge_by_replicates([self._u_values(case)], case, statistic, alpha)

    def _u_values(self, case: Case) -> Floats:
        """Return u-values of the replicates, (r, n)."""
        require_same(
            case.identity, self.optimum.search.identity, "JointNull: predicted", Level.OPTIMUM
        )
        evaluator = self.optimum.evaluator
        sampling = self.optimum.sampling()
        bounds = evaluator.reweighted.values()
        with designs_restored(bounds):
            try:
                tested = [self._tested(case, condition) for condition in case.conditions]
            except PoorEmulatorError as error:
                # Take all responses at the same points, those of the runs.
                for bound in bounds:
                    bound.design = bound.design.runs_alone()
                short = shortcomings(evaluator, self.optimum.theta[None])
                if short:
                    reasons = "; ".join(f"{name}: {reason}" for name, reason in short.items())
                    raise DesignError(
                        f"JointNull: {error}; its runs alone do not support the calibrated "
                        f"population ({reasons})"
                    ) from error
                tested = [self._tested(case, condition) for condition in case.conditions]
            return self._replicates(case, sampling, tested)

    def _replicates(
        self, case: Case, sampling: SamplingDistribution, tested: list[_Tested]
    ) -> Floats:
        """Draw specimens, recalibrate the model, and test their responses, (r, n)."""
        evaluator = self.optimum.evaluator
        theta = self.optimum.theta
        rng_of_ties = case.rng(1)
        numbers, n_new = _numbers_in_calibration(evaluator.nodes, tested)
        populations = [evaluator.populations(theta[None], k) for k in range(len(evaluator.nodes))]
        for t in tested:
            responses, weights = populations[t.simulator]
            _require_population(t.condition, t.projected(responses[0]), weights[0])
        points = simulated_points(
            evaluator, populations, self.replicates, self.random_seed, more=n_new
        )
        data = sets_at(evaluator, [values[0] for values, _ in populations], points)
        x, converged = refit(sampling, data)
        # If few minimisations converge, the remaining replicates are unusual data sets.
        if converged.mean() < 0.5:
            raise ValueError(
                f"JointNull: got {converged.mean():.0%} of the minimisations converged, expected "
                "most; look at prb.diagnose(optimum)"
            )
        thetas = sampling.thetas(x[converged])

        u = []
        for t, number in zip(tested, numbers, strict=True):
            drawn = points[t.simulator][converged][:, number]
            measured = t.projected(populations[t.simulator][0][0])[drawn]
            refitted, weights = evaluator.populations(thetas, t.simulator)
            values = np.broadcast_to(t.projected(refitted), weights.shape)
            rows = [
                Predictive(row, weight).transform(y, rng_of_ties)
                for row, weight, y in zip(values, weights, measured, strict=True)
            ]
            u.append(np.array(rows))
        joined = np.concatenate(u, axis=1)
        return joined[~np.isnan(joined).any(axis=1)]

    def _tested(self, case: Case, condition: TestedCondition) -> _Tested:
        """Return a condition with the simulator whose points are its specimens."""
        if condition.predicted.shape[0] > 1:
            raise ValueError(
                f"{condition.name}: predicted: got {len(condition.predicted)} draws, expected the "
                "one population at the optimum, which JointNull recalibrates; pass "
                "prb.predict(optimum, ...)"
            )
        name = condition.base_name
        nodes = self.optimum.evaluator.nodes
        tested = self.responses
        if isinstance(tested, Mapping):
            tested = tested.get(name)
        if tested is None:
            names = [node.name for node in nodes]
            if len({c.base_name for c in case.conditions}) == len(names) == 1:
                return _Tested(condition, 0, None)
            if name in names:
                return _Tested(condition, names.index(name), None)
            raise ValueError(
                f"JointNull: got the condition {name!r}, expected the name of a simulator, "
                f"{names}; or pass responses={{{name!r}: (response, *inputs)}}"
            )
        response, *inputs = tested
        refuse_uncallable(condition.name, response, order="(response, *inputs)")
        read = read_inputs_of_copy(condition.name, inputs, self.optimum.model, function=response)
        responses = Responses(
            condition.name,
            response,
            read,
            **call_settings(self.executor, self.store, self.version),
            outputs=None,
            caller="prb.validation.JointNull",
        )
        labels = set(condition.labels or ())
        # Prefer simulators that measured these specimens.
        shared = [
            node.specimens is not None and bool(labels & set(specimen_names(node.specimens)))
            for node in nodes
        ]
        ordered = [nodes[k] for k in np.argsort(np.logical_not(shared), kind="stable")]
        node = serving(ordered, responses)
        if node is None:
            raise ValueError(
                f"{condition.name}: responses: got inputs that no simulator with prb.Reweighted "
                "has, expected its .dist() objects, which identify the responses of the "
                "calibration's specimens"
            )
        assert node.reweighted is not None
        return _Tested(condition, nodes.index(node), node.reweighted.values_of(responses))


@dataclass(frozen=True, eq=False)
class _Tested:
    """A condition, and the simulator whose points are its specimens."""

    condition: TestedCondition
    simulator: int  # number of the simulator
    values: Floats | None  # responses at its points, (points,); None: those of the simulator

    def projected(self, responses: Floats) -> Floats:
        """Return the tested numbers at points where the simulator has these responses."""
        values = responses if self.values is None else self.values
        return np.asarray(self.condition.projected(values))


def _require_population(condition: TestedCondition, values: Floats, weights: Floats) -> None:
    """Raise if the predicted population is not that at the optimum."""
    predicted = condition.predicted[~np.isnan(condition.predicted)]
    # Between two of these quantiles the distribution function grows by .05, half of the difference
    # that is refused.
    at = np.quantile(predicted, np.linspace(0.05, 0.95, 19), method="nearest")
    expected = Predictive(values, weights).transform(at, None)
    got = Predictive(condition.predicted).transform(at, None)
    largest = np.abs(expected - got).max()
    # With probability 5%, 500 random samples differ from their population by .06 or more, and
    # samples of `predict` by far less. A normal population that is shifted by a quarter of a
    # standard deviation differs by .1.
    if largest > 0.1:
        raise ValueError(
            f"{condition.name}: predicted: got values whose distribution function differs by "
            f"{largest:.2f} from that of the population at the optimum, expected "
            "prb.predict(optimum, response, *inputs) of the same condition; for another condition "
            "than a simulator's pass responses="
        )


def _numbers_in_calibration(
    nodes: Sequence[Node], tested: list[_Tested]
) -> tuple[list[Indices], int]:
    """Return the specimens' numbers in the calibration, by condition, and how many are new."""
    node_numbers, total = number_specimens(nodes)
    # Points of simulators that share specimens are drawn together, as a group.
    group_of = {k: i for i, members in enumerate(groups(nodes)) for k in members}
    number_and_group = {}
    for k, node in enumerate(nodes):
        if node.specimens is not None:
            for label, number in zip(specimen_names(node.specimens), node_numbers[k], strict=True):
                number_and_group[label] = int(number), group_of[k]
    n_new = 0
    numbers = []
    for j, t in enumerate(tested):
        condition = t.condition
        node = nodes[t.simulator]
        calibrated = node.target.observed
        if data_digest(condition.measured) == data_digest(calibrated):
            # The data are those of the calibration, perhaps in another order.
            matched = np.empty(len(calibrated), dtype=np.intp)
            matched[in_order(condition.measured)] = node_numbers[t.simulator][in_order(calibrated)]
            numbers.append(matched)
            continue
        group = group_of[t.simulator]
        # Without labels every value belongs to a new specimen.
        labels = condition.labels or tuple(f"{j}, {i}" for i in range(condition.observed.size))
        for label in labels:
            if label not in number_and_group:
                number_and_group[label] = total + n_new, group
                n_new += 1
            elif number_and_group[label][1] != group:
                raise ValueError(
                    f"{condition.name}: specimens: got {label!r}, which is not a specimen of "
                    f"{node.name}, whose design is used, but of another simulator; expected "
                    "simulators that share labels and .dist() objects"
                )
        numbers.append(np.array([number_and_group[label][0] for label in labels], dtype=np.intp))
    return numbers, n_new
