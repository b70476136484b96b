"""Probability that a response exceeds a limit; if rare, by importance sampling near the limit."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Self

import numpy as np
import pymc as pm
import xarray as xr
from scipy.special import chdtri, gammaln, logsumexp, ndtr

from prbayes._display import Table, View, percentage
from prbayes._finding import Finding, Findings, as_json, report, sentences_of
from prbayes._stats import INTERVAL, positive_scale, tail_levels
from prbayes._validate import (
    AT_ONCE,
    ArrayFunction,
    Arrays,
    Bools,
    Floats,
    Function,
    Seed,
    StrPath,
    finite_number,
    positive_integer,
    seed_number,
    share,
)
from prbayes.decision.populations import (
    CentralSpecimens,
    InverseTransform,
    NestedPopulations,
    Populations,
    ResponseSample,
    left_out_findings,
    output_column,
    probability_bounds,
    rough_sample,
    share_error,
)
from prbayes.decision.quantities import (
    Exceedance,
    extreme_places,
    interval_grid,
    interval_values,
)
from prbayes.model.locking import locked
from prbayes.model.parameters import variables_at
from prbayes.model.random_variable import response_name
from prbayes.numerics.points import farthest_rows
from prbayes.optimize.optimum import Optimum
from prbayes.propagation.base import MAX_LOST, DesignError
from prbayes.response.discrepancy import findings_of
from prbayes.response.response import Responses, refuse_uncallable
from prbayes.results.predict import call_settings
from prbayes.results.products import ProductResults, each_product, joined_table


@locked
@each_product
def exceedance(
    result: Optimum | xr.DataTree,
    response: Function,
    limit: float,
    *inputs: Any,
    model: pm.Model | None = None,
    output: Any = None,
    below: bool = False,
    prob: float = INTERVAL,
    requirement: float | None = None,
    n_draws: int = 2000,
    n_points: int | None = None,
    steps: int = 5,
    executor: Executor | None = None,
    store: StrPath | None = None,
    version: str | None = None,
    random_seed: Seed = 0,
) -> ExceedanceTable:
    """Return the probability that a response is above a limit, with its interval.

    Each draw of the posterior is a population with its probability; the mean over draws is the
    probability of a new specimen. By default it comes from stored responses, whose number limits
    how small a probability they resolve. With ``n_points``, importance sampling computes that many
    responses near the limit, for all populations together: probabilities of one in a thousand to
    one in a million then have an error of some percent. Where stored responses cannot decide a
    ``requirement``, this is done without being asked, if it costs no more than the calibration.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution; or with a ``posterior`` group, from any
        sampler, or from `calibrate_each`: the result then has the dimension product, and
        ``verdict``, ``validity`` and ``finding`` as coordinates.
    response : callable
        As for `predict`; +inf is a specimen that failed, which is above every limit.
    limit : float
        In units of the response.
    *inputs
        As for `predict`. A ``prb.decision.Interval`` among them is a constant known only to lie
        between two ends: the probability then has bounds, which are searched between the ends.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    output : label, optional
        Which output, where a run of the response gives several.
    below : bool
        Whether to look below the limit.
    prob : float
        Probability of the interval.
    requirement : float, optional
        Largest acceptable probability. It is met if the whole interval, with two standard errors
        of the computation on both sides, is below it, not met if it is above it, and else not
        decided. Errors of few events are asymmetric, as those of Poisson counts.
    n_draws : int
        Largest number of populations, over all chains; the posterior's draws are thinned evenly.
    n_points : int, optional
        Number of responses to compute near the limit, for each point of the intervals and each
        family of the population; 0, or at least 100. The inputs need inverse distribution functions
        and a support that does not depend on hyperparameters, and no stored responses. By default
        0; but 1000 if the error of stored responses is above .3 of the distance between
        ``requirement`` and interval, and the calibration has at least 1000 runs.
    steps : int
        Number of values in each interval, its ends included; at least 2.
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
        ``probability`` of a new specimen; ``lower`` and ``upper``, the equal-tailed interval of
        the populations' probabilities, all in [0, 1]; ``error``, the standard error of
        ``probability`` from the points, the emulator and the draws; ``by_draw``, with dimension
        ``draw``. If no point is beyond the limit, or every point is, ``error`` is one over the
        effective number of points, and the interval ends at a bound (three over that number at
        95%). With intervals ``probability``, ``error`` and ``by_draw`` have the dimension
        ``bound``, "lower" and "upper"; ``lower`` and ``upper`` are the extremes over all points of
        the intervals, and the attribute ``at`` has the points of the bounds. It prints as
        sentences; a notebook shows a table. Attributes: ``prob``, ``limit``,
        ``below``, ``response`` (its name), ``responses`` (number computed), ``source``,
        ``findings`` (as JSON), ``identity``, and with a requirement ``requirement`` and
        ``verdict``: "met", "not met" or "not decided".

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses and there are no ``n_points``.
    DesignError
        If the design does not support the populations, or too many responses are NaN.
    ResponseError
        If the response raises, or has the wrong shape.

    Notes
    -----
    The error from stored responses is the jackknife over eight blocks of them. It is rather too
    large for one input, whose points divide the population into parts of equal mass. Extremes
    inside an interval are searched with 4 to 32 specimens at 32 further values, and from the best
    of all by halved steps; one that is much narrower is not found. The result of the calibration is
    the same at all values: vary a constant that the calibration also used there.

    Probabilities are those of specimens that have a response: NaN are left out, and reported. All
    of them may be within or beyond the limit, so that the interval is wider by their share.

    If the data do not separate a population of ``prbayes.families`` from a simpler one, the finding
    ``two-families`` has the probability and the verdict under the latter.

    References
    ----------
    .. [1] Owen, A. B. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat.
       Assoc. 95, 135-143, doi:10.1080/01621459.2000.10473909.
    .. [2] Ferson, S. and L. R. Ginzburg (1996), Different methods are needed to propagate ignorance
       and variability, Reliab. Eng. Syst. Saf. 54, 133-144, doi:10.1016/S0951-8320(96)00071-3.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     data = np.random.default_rng(1).normal(0, 1, 50)
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=data)
    >>> optimum = prb.minimize(model)
    >>> often = prb.exceedance(optimum, np.sinh, 1.0, x)
    >>> rarely = prb.exceedance(optimum, np.sinh, 50.0, x, n_points=1000)
    >>> bool(rarely.error < 0.15 * rarely.probability), rarely.attrs["responses"]
    (True, 1000)
    """
    _refuse_order(response, limit)
    quantity = Exceedance(response, *inputs, limit=limit, below=below, output=output)
    prob = share(prob, "prob")
    if requirement is not None:
        requirement = share(requirement, "requirement")
    positive_integer(n_draws, "n_draws", minimum=2)
    if n_points is not None:
        positive_integer(n_points, "n_points", minimum=0)
    if 0 < (n_points or 0) < 100:  # because the search for the limit takes steps of a part of them
        raise ValueError(f"n_points: got {n_points}, expected 0, or at least 100")
    positive_integer(steps, "steps", minimum=2)
    calling = call_settings(executor, store, version)
    populations = Populations.of(result, model, n_draws, "prb.exceedance", calling)
    question = _Question(populations, quantity, seed_number(random_seed))
    settings = _Settings(prob, requirement, steps, n_points)
    places, estimates, n_searched = question.over_intervals(settings)
    findings, n_nested = question.compared(estimates, settings)
    findings += findings_of(response)
    intervals = np.array([estimate.interval(prob) for estimate in estimates])
    bounds = [choose(estimates, key=lambda estimate: estimate.mean) for choose in (min, max)]
    # A probability is rough if two standard errors are about a factor of two, or would decide the
    # requirement.
    rough = [estimate for estimate in bounds if estimate.error > 0.3 * estimate.mean]
    decision = {}
    if requirement is not None:
        decision = {
            "requirement": requirement,
            "verdict": _verdict(estimates, requirement, prob),
        }
        if decision["verdict"] == "not decided":
            rough += [x for x in estimates if x.is_unsure(requirement, prob, 0.5)]
    table = ExceedanceTable(
        {
            "probability": ("bound", [estimate.mean for estimate in bounds]),
            "error": ("bound", [estimate.error for estimate in bounds]),
            "by_draw": (["bound", "draw"], [estimate.by_draw for estimate in bounds]),
            "lower": intervals[:, 0].min(),
            "upper": intervals[:, 1].max(),
        },
        coords={"bound": ["lower", "upper"]},
        attrs={
            "prob": prob,
            "limit": quantity.limit,
            "below": int(below),
            "response": response_name(response, quantity.output),
            "responses": n_searched + n_nested + sum(estimate.responses for estimate in estimates),
            "source": bounds[1].source,
            "random_seed": str(question.seed),
            "findings": as_json((*findings, *_error_findings(response, estimates, rough))),
            **populations.provenance(),
            **decision,
        },
    )
    if len(places) == 1:
        table = table.isel(bound=0, drop=True)
    else:
        table.attrs["at"] = [
            interval_values(inputs, places[estimates.index(estimate)]) for estimate in bounds
        ]
    return table


def _refuse_order(response: object, limit: object) -> None:
    """Raise if response or limit are no function or no number, as in another order."""
    order = "exceedance(result, response, limit, *inputs)"
    refuse_uncallable("prb.exceedance", response, order=order)
    try:
        finite_number(limit, "prb.exceedance: limit")
    except TypeError as error:
        raise TypeError(f"{error}; the order is {order}") from None


class ExceedanceTable(Table):
    """The probability of a response beyond a limit, with its interval."""

    __slots__ = ()
    _parts = ("probability", "error", "lower", "upper", "draw", "prob", "limit", "response")
    _columns = ("probability", "error", "lower", "upper")

    @classmethod
    def of_products(cls, parts: ProductResults[Self]) -> Self:
        """Return the tables of products as one with the dimension ``product``."""
        table = joined_table(parts, ("verdict", "responses", "at"))
        return cls(table.data_vars, coords=table.coords, attrs=table.attrs)

    def to_view(self) -> View:
        """Return what a reader sees."""
        attrs = self.attrs
        sides = "below" if attrs["below"] else "above"
        if "product" in self.dims:
            return self._view_of_products(f"{attrs['response']} is {sides} {attrs['limit']:g}")
        values = [f"{p:.2g}" for p in np.atleast_1d(self["probability"].values)]
        errors = [f"{error:.1g}" for error in np.atleast_1d(self["error"].values)]
        rows = [["standard error of the computation", *errors]]
        if len(values) > 1:
            rows.append(["intervals at", *map(str, attrs["at"])])
        sentences = sentences_of(attrs)
        if "requirement" in attrs:
            sentences.insert(
                0, f"At most {attrs['requirement']:g} is required: {attrs['verdict']}."
            )
        sentences.append(f"From {attrs['source']}; {attrs['responses']} responses computed.")
        heading = (
            f"Probability that {attrs['response']} is {sides} {attrs['limit']:g}: "
            f"{' to '.join(values)}, {percentage(attrs['prob'])} interval "
            f"{float(self['lower']):.2g} to {float(self['upper']):.2g}"
        )
        return View(heading, rows=rows, sentences=sentences)

    def _view_of_products(self, event: str) -> View:
        """Return a row for each product."""
        interval = f"{percentage(self.attrs['prob'])} interval"
        columns = {"probability": self["probability"], "error": self["error"]}
        rows = []
        for place, product in enumerate(self["product"].values.tolist()):
            of_product = {key: x.isel(product=place).values.ravel() for key, x in columns.items()}
            low, high = (float(self[key][place]) for key in ("lower", "upper"))
            probability = " to ".join(f"{p:.2g}" for p in of_product["probability"])
            row = [str(product), probability, f"{low:.2g} to {high:.2g}"]
            row.append(" to ".join(f"{error:.1g}" for error in of_product["error"]))
            rows.append([*row, *(str(self[key][place].item()) for key in self._verdicts)])
        header = ["", "probability", interval, "error", *self._verdicts.values()]
        heading = f"Probability that {event}, of {len(rows)} products"
        sentences = sentences_of(self.attrs)
        if "requirement" in self.attrs:
            sentences.insert(0, f"At most {self.attrs['requirement']:g} is required.")
        return View(heading, header, rows, sentences)

    @property
    def _verdicts(self) -> dict[str, str]:
        """Titles of columns with a verdict on each product, by coordinate."""
        titles = {"verdict": "requirement", "validity": "validity"}
        is_tested = (self["validity"] != "not tested").any()
        return {
            k: t for k, t in titles.items() if k in self.coords and (k != "validity" or is_tested)
        }


@dataclass(frozen=True)
class _Settings:
    """How probabilities are computed and judged."""

    prob: float
    requirement: float | None
    steps: int  # number of values in each interval
    n_points: int | None  # number of points near the limit


def _described(estimates: Sequence[_Estimate], settings: _Settings) -> str:
    """Return the largest probability with its interval, and the verdict, as a text."""
    largest = max(estimates, key=lambda estimate: estimate.mean)
    low, high = largest.interval(settings.prob)
    text = f"{largest.mean:.2g} ({percentage(settings.prob)} interval {low:.2g} to {high:.2g}"
    if settings.requirement is not None:
        verdict = _verdict(estimates, settings.requirement, settings.prob)
        text += f"; requirement {verdict}"
    return f"{text})"


def _verdict(estimates: Sequence[_Estimate], requirement: float, prob: float) -> str:
    """Return whether the whole interval meets a requirement, or none of it, or a part."""
    low, high = np.transpose([estimate.interval_with_error(prob) for estimate in estimates])
    if high.max() <= requirement:
        return "met"
    return "not met" if low.min() > requirement else "not decided"


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Probabilities at one point of the intervals."""

    by_draw: Floats  # (k,): probability in each population; NaN of populations that do not exist
    error: float
    responses: int  # number of responses computed
    source: str
    runs: int = 0  # number of stored responses behind the probabilities
    points: int = 0  # number of points near the limit
    lost: float = 0.0  # share of the populations without response
    findings: Findings = ()  # of the emulator

    @property
    def mean(self) -> float:
        """The probability of a new specimen."""
        return float(np.nanmean(self.by_draw))

    def of_populations(self, prob: float) -> Floats:
        """Return the interval over populations."""
        return np.nanquantile(self.by_draw, tail_levels(prob))

    def interval(self, prob: float) -> Floats:
        """Return the interval over populations, with a bound where no or every point counts.

        If no (or every) point exceeds the limit, the upper (lower) end is the one-sided bound of
        that share. Specimens without response are within the limit at the lower end, and beyond it
        at the upper end.
        """
        low, high = self.of_populations(prob)
        least, most = probability_bounds(self.mean, self.error, (1 - prob) / 2)
        if self.mean == 1:
            low = least
        if self.mean == 0:
            high = most
        return self._of_all(np.array([low, high]))

    def interval_with_error(self, prob: float) -> Floats:
        """Return the interval over populations, wider by two standard errors on both sides."""
        margins = probability_bounds(self.mean, self.error, float(ndtr(-2))) - self.mean
        return self._of_all(np.clip(self.of_populations(prob) + margins, 0.0, 1.0))

    def _of_all(self, interval: Floats) -> Floats:
        """Return the interval of all specimens from that of those with a response."""
        return np.asarray(interval * (1 - self.lost) + [0.0, self.lost])

    def is_unsure(self, requirement: float, prob: float, share: float = 0.3) -> bool:
        """Return whether the error is above a share of the interval's distance to a requirement."""
        distances = np.abs(self.of_populations(prob) - requirement)
        return bool(self.error > share * distances.min())


@dataclass(frozen=True, eq=False)
class _Question:
    """A response beyond a limit, in populations."""

    populations: Populations
    quantity: Exceedance
    seed: int
    # samples of the response by its inputs, shared by the families of the populations
    samples: dict[tuple[Any, ...], ResponseSample] = field(default_factory=dict)

    def estimate(self, inputs: tuple[Any, ...], points: int | None) -> _Estimate:
        """Return the probabilities by new points near the limit, or by stored responses if none."""
        quantity = self.quantity
        if points:
            responses = self.populations.responses(quantity.response, inputs)
            return _rare_probability(self.populations, responses, quantity, points, self.seed)
        count = 0
        if inputs not in self.samples:
            sample = self.populations.sample(quantity.response, inputs, quantity.output)
            self.samples[inputs] = sample
            count = sample.responses.count
        sample = replace(self.samples[inputs], populations=self.populations)
        by_draw = sample.evaluate(quantity.of, self.populations.thetas)
        error = share_error(sample, lambda values: quantity.of_specimen(values, np.nan))
        error = np.hypot(error, _error_of_draws(self.populations, by_draw))
        kind = "stored" if sample.design.has_runs else "emulated"
        source = f"{kind} responses of {self.populations.evaluator.simulators[sample.k].name}"
        n_runs = sample.design.n_runs
        findings = rough_sample(sample)
        return _Estimate(
            by_draw, float(error), count, source, n_runs, lost=sample.lost, findings=findings
        )

    def over_intervals(
        self, settings: _Settings
    ) -> tuple[list[tuple[Any, ...]], list[_Estimate], int]:
        """Return places of the intervals with their estimates, and the responses of the search."""
        quantity, n_points = self.quantity, settings.n_points
        places = interval_grid(quantity.inputs, settings.steps)
        estimates = [self.estimate(place, n_points) for place in places]
        count = 0
        if len(places) > 1:
            n_runs = n_points or estimates[0].runs
            respond = CentralSpecimens(self.populations, quantity.response, quantity.output, n_runs)
            extremes = extreme_places(quantity.inputs, places, respond, [quantity.limit])
            estimates += [self.estimate(place, n_points) for place in extremes]
            places, count = places + extremes, respond.count
        if n_points is None and settings.requirement is not None:
            estimates = [
                self.refined(estimate, place)
                if estimate.is_unsure(settings.requirement, settings.prob)
                else estimate
                for estimate, place in zip(estimates, places, strict=True)
            ]
        return places, estimates, count

    def compared(self, estimates: Sequence[_Estimate], settings: _Settings) -> tuple[Findings, int]:
        """Report the answers under the families that the data do not separate.

        The number is that of the responses of the simpler family.
        """
        nested, findings = NestedPopulations.of(self.populations)
        if nested is None:
            return findings, 0
        question = replace(self, populations=nested.populations)
        _, simpler, count = question.over_intervals(settings)
        answers = f"it is {_described(estimates, settings)}, or {_described(simpler, settings)}"
        finding = nested.finding(f"{answers} under the {nested.name} family")
        return report(finding), count + sum(estimate.responses for estimate in simpler)

    def refined(self, estimate: _Estimate, inputs: tuple[Any, ...]) -> _Estimate:
        """Return an estimate by new points, if they are no more than the runs of the first one.

        Inputs without an inverse distribution function keep the estimate.
        """
        points = 1000
        if estimate.runs < points:
            return estimate
        try:
            refined = self.estimate(inputs, points)
        except TypeError:
            return estimate
        return replace(refined, responses=estimate.responses + refined.responses)


def _rare_probability(
    populations: Populations, responses: Responses, quantity: Exceedance, points: int, seed: int
) -> _Estimate:
    """Return the probabilities of each population by importance sampling near the limit."""
    if responses.inputs.epistemic:
        raise TypeError(
            f"prb.exceedance: {responses.name}: got a model variable as an input, expected "
            ".dist() objects and constants; take the .dist() objects of the model, or "
            "prb.decision.Interval, or compute shares from prb.predict"
        )
    evaluator = populations.evaluator
    values = variables_at(evaluator.hyperparameters, populations.thetas)
    center = variables_at(evaluator.hyperparameters, populations.center[None])
    names = [str(rv.name) for rv in responses.inputs.parents]
    transform = InverseTransform(responses.name, responses.inputs, [center[name] for name in names])
    parents = [values[name] for name in names]
    if not transform.has_support_of(parents):
        raise TypeError(
            f"prb.exceedance: {responses.name}: got inputs whose support moves with their "
            "hyperparameters, so that points of one population do not represent the others; "
            "expected a support that stays; leave n_points= out, or count specimens of prb.predict"
        )
    sign = -1.0 if quantity.below else 1.0

    def respond(z: Floats) -> Floats:
        outputs = transform.responses(responses, z)
        column = output_column(responses, outputs, quantity.output)
        return sign * (outputs if column is None else outputs[:, column])

    rng = np.random.default_rng(seed)
    event = rare_event(transform, parents, respond, sign * quantity.limit, points, rng)
    if event.lost > MAX_LOST:
        raise DesignError(
            f"{responses.name}: lost mass: got {event.lost:.1%} of a population's weight on "
            f"points whose response is NaN, expected at most {MAX_LOST:.0%}; repair it, or "
            "return +inf for specimens that fail"
        )
    # Divide by the share with a response: the probability is that of specimens with a response, as
    # from stored responses.
    by_draw = np.minimum(event.by_draw / (1 - event.lost), 1.0)
    error = np.hypot(event.error / (1 - event.lost), _error_of_draws(populations, by_draw))
    count, lost = responses.count, event.lost
    return _Estimate(by_draw, float(error), count, "importance points", points=points, lost=lost)


def _error_of_draws(populations: Populations, by_draw: Floats) -> float:
    """Return the Monte Carlo error of the mean over draws of the posterior, as if independent."""
    n = np.isfinite(by_draw).sum()
    return float(np.nanstd(by_draw, ddof=1) / np.sqrt(n)) if populations.are_draws else 0.0


def _error_findings(
    response: Any, estimates: Sequence[_Estimate], rough: Sequence[_Estimate]
) -> Findings:
    """Report a probability with a large error, and a share of specimens without response."""
    name = response_name(response)
    findings = []
    if rough:
        worst = max(rough, key=lambda estimate: estimate.error - 0.3 * estimate.mean)
        more = "n_points=1000, which computes as many"
        if worst.points:
            more = f"more than n_points={worst.points}"
        text = (
            f"{name}: a probability of {worst.mean:.2g} has a standard error of "
            f"{worst.error:.2g}; pass {more} responses where the limit is exceeded."
        )
        findings.append(Finding("rough-probability", text))
    findings += next((list(x.findings) for x in estimates if x.findings), [])
    lost = max(estimate.lost for estimate in estimates)
    answer = (
        "the probability is that of the others, and the upper end of the interval counts all of "
        "them as beyond the limit"
    )
    return report(*findings) + left_out_findings(name, lost, answer)


@dataclass(frozen=True, eq=False)
class RareEvent:
    """Probabilities of an event in each population, and the error of their mean."""

    by_draw: Floats  # (k,): probability of the event in each population
    error: float  # standard error of their mean
    lost: float  # share of the populations' weight that has no response


@dataclass(frozen=True, eq=False)
class _Normal:
    """A normal proposal of z."""

    mean: Floats  # (D,)
    root: Floats  # (D, D): lower Cholesky factor of the covariance

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Return n draws, (n, D)."""
        z = rng.standard_normal((n, self.mean.size))
        return self.mean + z @ self.root.T

    def log_density(self, z: Floats) -> Floats:
        """Return the log-density, (n, D) -> (n,)."""
        standard = np.linalg.solve(self.root, (z - self.mean).T).T
        return log_normal(standard) - float(np.log(np.diag(self.root)).sum())


@dataclass(frozen=True)
class _Shell:
    """A proposal of z with a uniform direction, and a uniform radius in the tail."""

    d: int

    @property
    def radius(self) -> float:
        """The largest radius: a billionth of the population is beyond it."""
        return float(np.sqrt(chdtri(self.d, 1e-9)))

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Return n draws, (n, D), whose radius is at least half of the largest one."""
        z = rng.standard_normal((n, self.d))
        radius = self.radius * (1 + (np.arange(n) + rng.random(n)) / max(n, 1)) / 2
        return z * (radius / np.linalg.norm(z, axis=1))[:, None]

    def log_density(self, z: Floats) -> Floats:
        """Return the log-density, (n, D) -> (n,)."""
        radius = np.linalg.norm(z, axis=1)
        log_area = np.log(2) + self.d / 2 * np.log(np.pi) - gammaln(self.d / 2)
        logs = -np.log(self.radius / 2) - log_area - (self.d - 1) * np.log(radius)
        is_inside = (radius >= self.radius / 2) & (radius <= self.radius)
        return np.where(is_inside, logs, -np.inf)


type _Proposal = _Normal | _Shell


@dataclass(frozen=True, eq=False)
class _Points:
    """Points from several proposals, with their responses."""

    proposals: list[tuple[_Proposal, int]]  # proposals, each with its number of points
    z: Floats  # (n, D)
    values: Floats  # (n,)
    # (k, n): log ratio of the density of each population to that of the central one
    log_ratio: Floats

    def joined(self, more: _Points) -> _Points:
        """Return these and more points."""
        return _Points(
            self.proposals + more.proposals,
            np.concatenate([self.z, more.z]),
            np.concatenate([self.values, more.values]),
            np.concatenate([self.log_ratio, more.log_ratio], axis=1),
        )

    def log_mixture(self) -> Floats:
        """Return the log-density of the mixture of all proposals at the points, (n,)."""
        logs = [proposal.log_density(self.z) for proposal, _ in self.proposals]
        sizes = np.array([size for _, size in self.proposals])
        return np.asarray(logsumexp(logs, axis=0, b=sizes[:, None] / sizes.sum()))

    def log_weights(self) -> Floats:
        """Return the log importance weights for all populations together, (n,)."""
        pooled = logsumexp(self.log_ratio, axis=0)
        return np.asarray(pooled + log_normal(self.z) - self.log_mixture())


def rare_event(
    transform: InverseTransform,
    parents: Arrays,
    respond: ArrayFunction,
    limit: float,
    size: int,
    rng: np.random.Generator,
) -> RareEvent:
    r"""Return the probability that a response is above a limit, in each of k populations.

    Points are standard normal numbers z behind the inputs of a central population
    :math:`\theta_*`. A quarter explores, with up to five numbers in all directions up to the far
    tail. From points with large responses, proposals in separate parts move towards the limit step
    by step, each by the cross-entropy method [1]_. The last three eighths are drawn from the
    mixture q of the last proposals, and count:

    .. math:: P_j = \frac{1}{n} \sum_i 1[y_i > c] \frac{p(x_i | \theta_j)}{p(x_i | \theta_*)}
        \frac{\phi(z_i)}{q(z_i)}

    The error has half the difference from the estimate of all points, which sees parts of the
    region that the last proposals miss.

    ``transform`` is that of the central population, ``parents`` are those of the k populations,
    ``respond`` maps normal numbers (n, D) to responses (n,), and ``size`` is the number of these.

    References
    ----------
    .. [1] Rubinstein, R. Y. and D. P. Kroese (2004), The cross-entropy method, Springer,
       doi:10.1007/978-1-4757-4321-0.
    .. [2] Owen, A. B. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat.
       Assoc. 95, 135-143, doi:10.1080/01621459.2000.10473909.
    """
    d = transform.size
    # The first proposal is wider than the population, so that weights are bounded. It is less wide
    # in each of many dimensions.
    wide: list[_Proposal] = [_Normal(np.zeros(d), (1 + 0.5 / np.sqrt(d)) * np.eye(d))]
    if d <= 5:  # points of a shell in more dimensions seldom meet a small region
        wide.append(_Shell(d))
    draw = partial(_draw_points, transform, parents, respond, rng)
    search = draw(wide, max(size // 4, 2))
    parts, used, most = _first_parts(search, limit), len(search.z), 5 * size // 8
    while used < most:
        parts, between = _separate(parts, respond, limit)
        batch = draw(_mixture(parts, wide), max(min(size // 25, most - used), 1))
        used += between + len(batch.z)
        search = search.joined(batch)
        parts = _moved(parts, search, limit)
    # The estimate is unbiased, because the proposals do not depend on the final points.
    final = draw(_mixture(parts, wide), max(size - used, 2))
    weights = np.exp(final.log_ratio + (log_normal(final.z) - final.log_mixture()))
    mean_weights = weights.mean(axis=0)
    is_beyond = ~np.isnan(final.values) & (final.values > limit)
    _, error = weighted_share(mean_weights[None], is_beyond)
    if not is_beyond.any():
        # No point exceeds the limit. Bound the probability by that of exceeding the median
        # response, which contains the event.
        values = np.where(np.isnan(final.values), -np.inf, final.values)
        is_above = final.values >= np.median(values)
        above, above_error = weighted_share(mean_weights[None], is_above)
        error = min(error, float(above[0] + 2 * above_error) / 3)
    points = search.joined(final)
    by_draw = weighted_share(weights, is_beyond)[0]
    estimate = weighted_share(mean_weights[None], is_beyond)[0]
    all_weights = np.exp(points.log_ratio + (log_normal(points.z) - points.log_mixture()))
    of_all = weighted_share(all_weights.mean(axis=0)[None], points.values > limit)[0]
    log_weights = points.log_weights()
    shares = np.exp(log_weights - log_weights.max())
    return RareEvent(
        by_draw=by_draw,
        error=float(np.hypot(error, (of_all - estimate)[0] / 2)),
        lost=float(shares[np.isnan(points.values)].sum() / shares.sum()),
    )


def weighted_share(weights: Floats, counts: Bools) -> tuple[Floats, float]:
    r"""Return shares of points that count, by rows of weights (k, n), and the first one's error.

    The mean of a weight is known to be one. With this as a control variate (Owen and Zhou 2000),
    :math:`\hat P = \overline{w 1} - \beta (\bar w - 1)`, shares of all points are one, and those
    of few are the plain mean. If all points or none count, the error is one over the effective
    number of points.
    """
    terms = np.where(counts, weights, 0.0)
    totals = weights.mean(axis=1)
    if counts.all() or not counts.any():
        shares = np.full(len(weights), float(counts[0]))
        n_effective = weights[0].sum() ** 2 / (weights[0] ** 2).sum()
        return shares, float(1 / n_effective)
    deviation = weights - totals[:, None]
    variance = (deviation**2).sum(axis=1)
    covariance = (terms * deviation).sum(axis=1)
    slope = covariance / positive_scale(variance)
    shares = terms.mean(axis=1) - slope * (totals - 1)
    residuals = terms[0] - slope[0] * weights[0]
    error = residuals.std(ddof=1) / np.sqrt(residuals.size)
    return np.clip(shares, 0.0, 1.0), float(error)


def _draw_points(
    transform: InverseTransform,
    parents: Arrays,
    respond: ArrayFunction,
    rng: np.random.Generator,
    proposals: list[_Proposal],
    n: int,
) -> _Points:
    """Draw n points, in equal parts from each proposal, and compute their responses."""
    sizes = [len(part) for part in np.array_split(np.arange(n), len(proposals))]
    draws = [proposal.draw(size, rng) for proposal, size in zip(proposals, sizes, strict=True)]
    z = np.concatenate(draws)
    x = transform(z)
    central = transform.log_density(transform.parents, x)
    step = max(1, AT_ONCE // n)
    log_ratio = [
        transform.log_density([values[first : first + step] for values in parents], x) - central
        for first in range(0, len(parents[0]), step)
    ]
    pairs = list(zip(proposals, sizes, strict=True))
    return _Points(pairs, z, respond(z), np.concatenate(log_ratio))


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of the region where responses are above a level, with a proposal in it."""

    level: float  # rises to the limit
    proposal: _Normal  # centred on the part


def _mixture(parts: list[_Part], wide: list[_Proposal]) -> list[_Proposal]:
    """Return proposals of equal shares; the wide ones have a tenth, so that weights are bounded."""
    return [part.proposal for part in parts] * max(1, 18 // len(parts)) + wide


def _first_parts(points: _Points, limit: float) -> list[_Part]:
    """Return parts at points of the highest fifth of the responses that are far from each other.

    The first one is the nearest to the origin. In many dimensions it is the only one, because
    directions of points are all different there.
    """
    values = np.where(np.isnan(points.values), -np.inf, points.values)
    highest_fifth = float(np.quantile(values, 0.8, method="lower"))
    level = min(highest_fifth, limit)
    above = points.z[values >= level]
    distance = (above**2).sum(axis=1)
    above = above[np.argsort(distance)]
    d = above.shape[1]
    most = 6 if d <= 5 else 3 if d <= 20 else 1
    rows = farthest_rows(above, min(most, len(above)))
    parts = [_Part(level, _Normal(z, np.eye(d))) for z in above[rows]]
    return _moved(parts, points, limit)


def _moved(parts: list[_Part], points: _Points, limit: float) -> list[_Part]:
    """Return parts whose level and proposal follow from the points nearest to their centers."""
    values = np.where(np.isnan(points.values), -np.inf, points.values)
    centers = np.array([part.proposal.mean for part in parts])
    distance = np.linalg.norm(points.z[:, None] - centers, axis=2)
    owner, log_weights = distance.argmin(axis=1), points.log_weights()
    result = []
    for k, part in enumerate(parts):
        is_own, level = owner == k, part.level
        is_near = is_own & (distance[:, k] < 3 + np.sqrt(points.z.shape[1]))
        if is_near.any():
            # The highest fifth of the responses is usual for the cross-entropy method.
            level = max(level, float(np.quantile(values[is_near], 0.8, method="lower")))
        level = min(level, limit)
        is_above = is_own & (values >= level)
        if is_above.any():
            weights = np.exp(log_weights[is_above] - log_weights[is_above].max())
            # Bound the variance towards the limit from below. Narrow proposals would slow the
            # search before the limit is reached. Beyond four standard deviations a normal tail has
            # a variance of .05.
            least = 0.1 if level >= limit else 1.0
            part = _Part(level, _tail_normal(points.z[is_above], weights, least))
        result.append(part)
    return result


def _separate(parts: list[_Part], respond: ArrayFunction, limit: float) -> tuple[list[_Part], int]:
    """Return parts that are separate, and the number of responses that this needed.

    Two parts are the same if the response halfway between them is above the lower level. A part
    below the limit and one that has reached it stay: points nearer to the origin are more likely.
    """
    parts = sorted(parts, key=lambda part: (-part.level, (part.proposal.mean**2).sum()))
    pairs = [
        (i, j)
        for j in range(len(parts))
        for i in range(j)
        if (parts[i].level >= limit) == (parts[j].level >= limit)
    ]
    if not pairs:
        return parts, 0
    values = respond(
        np.array([(parts[i].proposal.mean + parts[j].proposal.mean) / 2 for i, j in pairs])
    )
    is_same = {
        pair: value >= min(parts[pair[0]].level, parts[pair[1]].level)
        for pair, value in zip(pairs, values, strict=True)
    }
    kept: list[int] = []
    for j in range(len(parts)):
        if not any(is_same.get((i, j), False) for i in kept):
            kept.append(j)
    return [parts[i] for i in kept], len(pairs)


def _tail_normal(z: Floats, weights: Floats, least: float) -> _Normal:
    """Return a normal distribution with the mean of points, and their variance along it.

    The covariance is isotropic in the other directions, because few points do not determine it.
    """
    total = weights.sum()
    mean = weights @ z / total
    direction = mean / max(float(np.linalg.norm(mean)), 1e-300)
    shares = weights / total
    deviation = z - mean
    whole = float(shares @ (deviation**2).sum(axis=1))
    along = float(shares @ (deviation @ direction) ** 2)
    # Inflate the other directions by 20 %, so that importance weights stay bounded in the tails.
    across = 1.2 * max((whole - along) / max(mean.size - 1, 1), 1.0)
    outer = np.outer(direction, direction)
    covariance = across * (np.eye(mean.size) - outer) + max(along, least) * outer
    return _Normal(mean, np.linalg.cholesky(covariance))


def log_normal(z: Floats) -> Floats:
    """Return the log-density of independent standard normal numbers, (n, D) -> (n,)."""
    return np.asarray(-0.5 * (z**2).sum(axis=1) - 0.5 * z.shape[1] * np.log(2 * np.pi))
