"""`exceedance`: the probability that a response is beyond a limit, with its interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import Finding, report
from prbayes._validate import (
    Floats,
    Seed,
    executes,
    finite_number,
    flag,
    positive_integer,
    seed_number,
    share,
)
from prbayes.decision.importance_sampling import rare
from prbayes.decision.interval import intervals, told_places, variants
from prbayes.decision.inverse_transform import Specimens
from prbayes.decision.populations import Populations, Told, output_place
from prbayes.decision.quantities import Exceedance
from prbayes.model.fingerprint import as_attributes, identity_of_model
from prbayes.model.labels import versions
from prbayes.model.locking import in_turn
from prbayes.model.random_variable import response_name
from prbayes.optimize.optimum import Optimum, identity_in
from prbayes.propagation.base import MAX_LOST, N_BLOCKS, DesignError
from prbayes.response.response import refuse_uncallable

# Error of a probability, as a share of it, from which on it is said that points are needed. By
# judgement: a probability is then known to a factor of two, with two errors to either side.
_ROUGH = 0.3
# Populations whose weights tell the error of an emulator: they are held at all points.
_EMULATED_AT = 400
# Importance points at least: a tenth of them is a step towards the limit, of which a fifth counts.
_FEWEST_POINTS = 100


@in_turn
def exceedance(
    result: Optimum | xr.DataTree,
    response: Callable[..., Any],
    limit: float,
    *inputs: Any,
    model: pm.Model | None = None,
    output: Any = None,
    below: bool = False,
    prob: float = 0.89,
    requirement: float | None = None,
    n_draws: int = 2000,
    points: int = 0,
    steps: int = 5,
    executor: Executor | None = None,
    random_seed: Seed = 0,
) -> xr.Dataset:
    """Return the probability that a response is above a limit, with its interval.

    Each draw of the posterior is a population, with a probability of its own; their mean is that of
    a new specimen. By default it comes from stored responses alone, whose number bounds
    how small a probability they tell. With ``points``, that many responses are computed where the
    limit is exceeded, for all populations together: probabilities of one in a thousand to one in a
    million then have an error of some percent.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution; or with a ``posterior`` group, from any
        sampler.
    response : callable
        As for `predict`; +inf is a specimen that failed, which is above every limit.
    limit : float
        In units of the response.
    *inputs
        As for `predict`. An ``prb.decision.Interval`` among them is a constant known only to lie
        between two ends: the answer then has bounds, and no distribution over it.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    output : label, optional
        Which output, where a run of the response gives several.
    below : bool
        Whether to look below the limit.
    prob : float
        Probability of the interval.
    requirement : float, optional
        The largest probability that is accepted. It is met if the whole interval is below it, not
        met if all of it is above, and not decided in between.
    n_draws : int
        Largest number of populations, over all chains; the posterior's draws are thinned evenly.
    points : int
        How many responses are computed where they matter, for each place in the intervals; 0, or
        at least 100. The inputs need inverse distribution functions, and no stored responses.
    steps : int
        Places in each interval, its ends among them; at least 2.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    random_seed : int, sequence of int, numpy.random.Generator or None

    Returns
    -------
    xarray.Dataset
        ``probability``, of a new specimen; ``lower`` and ``upper``, the equal-tailed interval of
        the populations' probabilities; ``error``, the standard error of ``probability`` by the
        points, the emulator and the draws that it was made from; ``by_draw``, with dimension
        ``draw``. With intervals ``probability`` and ``error`` have the dimension ``bound``,
        "lower" and "upper"; ``lower`` and ``upper`` are the ends over all places, ``by_draw`` has
        ``bound`` too, and the attribute ``at`` says where in the intervals the bounds are.
        Attributes: ``prob``, ``responses`` (how many were computed), ``source``, ``identity``, and
        with a requirement ``requirement`` and ``verdict``: "met", "not met" or "not decided".

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses and there are no ``points``.
    DesignError
        If the design does not support the populations, or too many responses are NaN.
    ResponseError
        If the response raises, or has the wrong shape.

    Notes
    -----
    The error of stored responses is that of the jackknife over eight blocks of them; of one input,
    whose points cut the population into parts of equal mass, it is rather too large. Extremes
    inside an interval are looked for at ``steps`` places only. The result of the calibration is the
    same at all of them: a constant that the calibration used as well is to be varied there.

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
    >>> rarely = prb.exceedance(optimum, np.sinh, 50.0, x, points=1000)
    >>> bool(rarely.error < 0.15 * rarely.probability), rarely.attrs["responses"]
    (True, 1000)
    """
    caller = "prb.exceedance"
    refuse_uncallable(caller, response)
    limit = finite_number(limit, "limit")
    flag(below, "below")
    prob = share(prob, "prob")
    if requirement is not None:
        requirement = share(requirement, "requirement")
    positive_integer(n_draws, "n_draws", minimum=2)
    positive_integer(points, "points", minimum=0)
    if 0 < points < _FEWEST_POINTS:
        raise ValueError(f"points: got {points}, expected 0, or at least {_FEWEST_POINTS}")
    positive_integer(steps, "steps", minimum=2)
    executes(executor, "executor")
    seed = seed_number(random_seed)
    populations = Populations.of(result, model, n_draws, caller)
    asked = _Asked(populations, response, limit, output, below, points, executor, seed)
    places = variants(inputs, steps)
    found = [asked.at(place) for place in places]
    by_draw = np.array([one.by_draw for one in found])
    tails = [(1 - prob) / 2, (1 + prob) / 2]
    low, high = np.quantile(by_draw, tails, axis=1)
    means = by_draw.mean(axis=1)
    ends = [int(means.argmin()), int(means.argmax())]
    errors = np.array([one.error for one in found])
    _tell(response, means[ends], errors[ends], points)
    identity = identity_in(result) or identity_of_model(populations.evaluator.model)
    attrs = {
        "prob": prob,
        "limit": limit,
        "below": int(below),
        "responses": sum(one.responses for one in found),
        "source": found[0].source,
        "random_seed": str(seed),
        **as_attributes(identity),
        **versions(),
    }
    if not intervals(inputs):
        data: dict[str, Any] = {
            "probability": means[0],
            "error": errors[0],
            "by_draw": ("draw", by_draw[0]),
        }
        coords = {}
    else:
        data = {
            "probability": ("bound", means[ends]),
            "error": ("bound", errors[ends]),
            "by_draw": (["bound", "draw"], by_draw[ends]),
        }
        coords = {"bound": ["lower", "upper"]}
        attrs["at"] = [told_places(inputs, places[end]) for end in ends]
    data |= {"lower": low.min(), "upper": high.max()}
    if requirement is not None:
        attrs |= {"requirement": requirement, "verdict": _verdict(data, requirement)}
    return xr.Dataset(data, coords=coords, attrs=attrs)


@dataclass(frozen=True, eq=False)
class _Found:
    """Probabilities of one variant of the inputs."""

    by_draw: Floats  # (k,)
    error: float
    responses: int
    source: str


@dataclass(frozen=True, eq=False)
class _Asked:
    """What is asked of a response, but for its inputs."""

    populations: Populations
    response: Callable[..., Any]
    limit: float
    output: Any
    below: bool
    points: int
    executor: Executor | None
    seed: int

    def at(self, inputs: Sequence[Any]) -> _Found:
        """Return probabilities for some inputs."""
        return self._by_points(inputs) if self.points else self._stored(inputs)

    def _stored(self, inputs: Sequence[Any]) -> _Found:
        """Return them from stored responses."""
        told = self.populations.told(self.response, inputs, self.output, executor=self.executor)
        quantity = Exceedance(self.response, *inputs, limit=self.limit, below=self.below)
        by_draw = told.at(quantity, self.populations.thetas)
        known = by_draw[np.isfinite(by_draw)]
        error = np.linalg.norm(
            [
                _error_of_points(told, quantity),
                _error_of_emulator(told, quantity),
                self._error_of_draws(known),
            ]
        )
        kind = "stored" if told.emulator is None else "emulated"
        source = f"{kind} responses of {self.populations.evaluator.simulators[told.k].name}"
        return _Found(known, float(error), told.responses.count, source)

    def _by_points(self, inputs: Sequence[Any]) -> _Found:
        """Return them from points that are drawn where they matter."""
        responses = self.populations.responses(self.response, inputs, executor=self.executor)
        if responses.inputs.epistemic:
            raise TypeError(
                f"prb.exceedance: {responses.name}: got a model variable as an input, expected "
                ".dist() objects and constants; take the .dist() objects of the model, or "
                "prb.decision.Interval"
            )
        evaluator = self.populations.evaluator
        values = evaluator.constrained(self.populations.thetas)
        center = evaluator.constrained(self.populations.center[None])
        names = [str(rv.name) for rv in responses.inputs.roots]
        specimens = Specimens(responses.name, responses.inputs, [center[name] for name in names])
        sign = -1.0 if self.below else 1.0

        def respond(z: Floats) -> Floats:
            found = specimens.computed(responses, z)
            place = output_place(responses, found, self.output)
            return sign * (found if place is None else found[:, place])

        rng = np.random.default_rng(self.seed)
        roots = [values[name] for name in names]
        found = rare(specimens, roots, respond, sign * self.limit, self.points, rng)
        if found.lost > MAX_LOST:
            raise DesignError(
                f"{responses.name}: lost mass: got {found.lost:.1%} of a population's weight on "
                f"points whose response is NaN, expected at most {MAX_LOST:.0%}; repair it, or "
                "return +inf for specimens that fail"
            )
        error = np.hypot(found.error, self._error_of_draws(found.by_draw))
        return _Found(found.by_draw, float(error), responses.count, "importance points")

    def _error_of_draws(self, by_draw: Floats) -> float:
        """Return the error of a mean over draws of the posterior, as if they were independent."""
        if not self.populations.drawn:
            return 0.0
        return float(by_draw.std(ddof=1) / np.sqrt(by_draw.size))


def _error_of_points(told: Told, quantity: Exceedance) -> float:
    """Return the error of the mean probability, by the jackknife over blocks of the points."""
    thetas = told.populations.thetas
    beyond = quantity.of_specimen(told.values, np.nan)
    weights = told.mean_weights(thetas)
    if not (weights * beyond).any():
        # No point is there: what a single one stands for where there are some.
        return float(weights.max())
    without = []
    for block in range(N_BLOCKS):
        left = weights * (told.blocks != block)
        without.append(left @ beyond / left.sum())
    return float(np.sqrt((N_BLOCKS - 1) * np.var(without)))


def _error_of_emulator(told: Told, quantity: Exceedance) -> float:
    """Return the error of the mean probability, by emulators without a block of the runs each."""
    design = told.design
    said = told.emulated(told.points)
    if not said:
        return 0.0
    # Of some populations: those emulators differ by far less than populations do.
    thetas = told.populations.thetas[:: max(1, len(told.populations.thetas) // _EMULATED_AT)]
    roots = told.populations.evaluator.roots(thetas, told.k)
    _, weights = design.populations(roots)
    mass = np.nanmean(weights, axis=0)
    shares = [mass @ quantity.of_specimen(values, np.nan) for values in said]
    return float(np.sqrt(np.sum((np.array(shares[1:]) - shares[0]) ** 2)))


def _verdict(data: dict[str, Any], requirement: float) -> str:
    """Return whether a probability is as required, by its interval."""
    if data["upper"] <= requirement:
        return "met"
    return "not met" if data["lower"] > requirement else "not decided"


def _tell(response: Any, means: Floats, errors: Floats, points: int) -> None:
    """Say so where a probability is hardly known."""
    rough = errors > _ROUGH * means
    if not rough.any():
        return
    worst = int(np.argmax(errors - _ROUGH * means))
    name = response_name(response)
    more = f"more than points={points}" if points else "points=1000, which computes as many"
    report(
        Finding(
            "rough-probability",
            f"{name}: a probability of {means[worst]:.2g} has a standard error of "
            f"{errors[worst]:.2g}; pass {more} responses where the limit is exceeded.",
        )
    )
