"""`JointNull`: the area test on the very specimens of the calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats, called, positive_integer
from prbayes.inference.refits import SamplingDistribution
from prbayes.inference.resampling import groups, sets_at, simulated_points, specimens
from prbayes.model.coverage import shortcomings
from prbayes.model.fingerprint import Level, require_same
from prbayes.model.random_variable import Node
from prbayes.optimize.optimum import Optimum, require_refits
from prbayes.propagation.base import DesignError
from prbayes.propagation.reweighted import UntoldError
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses, refuse_uncallable
from prbayes.results.predict import data_digest, in_order, serving, specimen_names
from prbayes.validation.conditions import Case, Condition
from prbayes.validation.nulls import LEAST_REPLICATES, SimulatedNull
from prbayes.validation.predictive import Predictive


@dataclass(frozen=True)
class JointNull(SimulatedNull):
    """Calibration and test data come together from the calibrated model.

    The model is calibrated anew each time.

    For tests on the calibration's own specimens, under the same conditions or others: a model that
    was fitted to them follows them more closely than fresh ones. Each replicate draws specimens
    from the population at the optimum, minimises the discrepancy for their calibration data, and
    tests their responses against the population found. The predicted population is that of
    `predict` with the optimum. Minimisations are those of the parametric `bootstrap`: with
    `Reweighted` they compute no response.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`, without the prior.
    responses : tuple or mapping, optional
        ``(response, *inputs)`` of the tested condition, or such tuples by the names of conditions,
        as they were given to `predict`. Conditions without one are the model's simulators, by name;
        one condition alone is the only simulator.
    replicates : int
    random_seed : int

    Raises
    ------
    TypeError
        If ``optimum`` is no Optimum, or a response cannot be called.
    ValueError
        If nothing is known of a metric or propagation (`FunctionMetric`, `Fresh`); if the prior was
        part of the optimum, or its model has changed since.

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

    optimum: Optimum = field(repr=False)
    _: KW_ONLY
    responses: tuple[Any, ...] | Mapping[str, tuple[Any, ...]] | None = field(
        default=None, repr=False
    )
    replicates: int = 999
    random_seed: int = 0

    def __post_init__(self) -> None:
        advice = ", so that the model cannot be calibrated anew; use prb.validation.PosteriorNull()"
        require_refits(self.optimum, "JointNull", advice)
        _refuse_responses(self.responses)
        positive_integer(self.replicates, "JointNull: replicates", minimum=LEAST_REPLICATES)
        positive_integer(self.random_seed, "JointNull: random_seed", minimum=0)

    def replicates_of(self, case: Case) -> Iterator[Floats]:
        """Draw, calibrate, test."""
        require_same(case.identity, self.optimum.identity, "JointNull: predicted", Level.OPTIMUM)
        sampling = self.optimum.sampling()
        with ExitStack() as alone:
            try:
                served = [self._served(case, condition) for condition in case.conditions]
            except UntoldError as untold:
                # All on the same points: those of the runs.
                for design in self.optimum.evaluator.designs.values():
                    alone.enter_context(design.alone())
                self._refuse_unsupported(untold)
                served = [self._served(case, condition) for condition in case.conditions]
            found = self._replicates(case, served, sampling)
        # Designs are whole again before anyone else goes on.
        yield found

    def _refuse_unsupported(self, untold: UntoldError) -> None:
        """Raise if the runs by themselves are too few for the population at the optimum."""
        short = shortcomings(self.optimum.evaluator, self.optimum.theta[None])
        if short:
            what = "; ".join(f"{name}: {each}" for name, each in short.items())
            raise DesignError(
                f"JointNull: {untold}; its runs alone do not support the calibrated population "
                f"({what})"
            ) from untold

    def _replicates(
        self, case: Case, served: list[_Served], sampling: SamplingDistribution
    ) -> Floats:
        evaluator = self.optimum.evaluator
        theta = self.optimum.theta
        ties = case.rng(1)
        numbers, more = _specimen_numbers(evaluator.nodes, served)
        simulators = range(len(evaluator.nodes))
        populations = [evaluator.populations(theta[None], k) for k in simulators]
        for one in served:
            values, weights = populations[one.simulator]
            seen = one.condition.view.of(one.values_or(values[0]))
            _refuse_other(one.condition, seen, weights[0])

        # Draw specimens, and calibrate the model to what is measured on them.
        points = simulated_points(
            evaluator, populations, self.replicates, self.random_seed, more=more
        )
        thetas, converged = self._calibrated(sampling, populations, points)

        # Test their responses against the population that was found.
        u: list[Floats] = []
        for one, number in zip(served, numbers, strict=True):
            at_optimum, _ = populations[one.simulator]
            drawn = points[one.simulator][converged][:, number]
            measured = one.values_or(at_optimum[0])[drawn]
            refitted, weights = evaluator.populations(thetas, one.simulator)
            see = one.condition.view.of
            measured = see(measured)
            values = np.broadcast_to(see(one.values_or(refitted)), weights.shape)
            found = []
            for row, weight, y in zip(values, weights, measured, strict=True):
                found.append(Predictive(row, weight).transform(y, ties))
            u.append(np.array(found))
        together = np.concatenate(u, axis=1)
        missing = np.isnan(together).any(axis=1)
        return np.asarray(together[~missing])

    def describe(self, case: Case) -> str:
        """Return what is held to be true."""
        return (
            "calibration and test data come from the calibrated model, which is calibrated anew in "
            "each replicate"
        )

    def _calibrated(
        self,
        sampling: SamplingDistribution,
        populations: list[tuple[Floats, Floats]],
        points: list[NDArray[np.intp]],
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the minimisers of the replicates that converged, (r, d), and which did."""
        evaluator = self.optimum.evaluator
        x, converged = sampling.refit(sets_at(evaluator, populations, points))
        # Replicates are then those of most data sets, and not of an odd few.
        if converged.mean() < 0.5:
            raise ValueError(
                f"JointNull: got {converged.mean():.0%} of the minimisations converged, expected "
                "most; look at prb.diagnose(optimum)"
            )
        return sampling.thetas(x[converged]), converged

    def _served(self, case: Case, condition: Condition) -> _Served:
        """Return the simulator whose points are the specimens, and the responses at them."""
        if condition.predicted.shape[0] > 1:
            raise ValueError(
                f"{condition.name}: predicted: got {len(condition.predicted)} draws, expected the "
                "one population at the optimum, which JointNull calibrates anew; pass "
                "prb.predict(optimum, ...)"
            )
        given = self.responses
        if isinstance(given, Mapping):
            given = given.get(condition.of)
        if given is None:
            return _Served(condition, self._own_simulator(case, condition), None)

        response, *inputs = given
        refuse_uncallable(condition.name, response)
        sorted_inputs = read_inputs(condition.name, inputs, self.optimum.model)
        called = Responses(condition.name, response, sorted_inputs, outputs=None)
        nodes = self.optimum.evaluator.nodes
        node = serving(_measuring_first(nodes, condition), called)
        if node is None:
            raise ValueError(
                f"{condition.name}: responses: got inputs that no simulator with prb.Reweighted "
                "has, expected its .dist() objects; only then is it known which responses belong "
                "to the specimens of the calibration"
            )
        assert node.design is not None
        return _Served(condition, nodes.index(node), node.design.values_of(called))

    def _own_simulator(self, case: Case, condition: Condition) -> int:
        """Return the simulator that a condition without a response stands for."""
        names = [node.name for node in self.optimum.evaluator.nodes]
        tested = {one.of for one in case.conditions}
        if len(tested) == len(names) == 1:
            return 0
        if condition.of in names:
            return names.index(condition.of)
        raise ValueError(
            f"JointNull: got the condition {condition.of!r}, expected the name of a simulator, "
            f"{names}; or pass responses={{{condition.of!r}: (response, *inputs)}}"
        )


def _refuse_responses(responses: object) -> None:
    """Raise if they are neither a tuple of a response and its inputs, nor several by condition."""
    if responses is None:
        return
    each = list(responses.values()) if isinstance(responses, Mapping) else [responses]
    if not each or not all(isinstance(one, tuple) and one and callable(one[0]) for one in each):
        raise TypeError(
            f"JointNull: responses: got {called(responses)}, expected a tuple (response, *inputs), "
            "or a mapping of conditions to such"
        )


@dataclass(frozen=True, eq=False)
class _Served:
    """A condition, and the simulator whose points are its specimens."""

    condition: Condition
    simulator: int
    # (points,), or None: responses at the simulator's points, unless they are its own.
    values: Floats | None

    def values_or(self, own: Floats) -> Floats:
        """Return the responses, or the simulator's own ones."""
        return own if self.values is None else self.values


def _measuring_first(nodes: list[Node], condition: Condition) -> list[Node]:
    """Return the simulators, first those that measured a condition's specimens."""
    labels = set(condition.labels or ())

    def measured_others(node: Node) -> bool:
        return node.specimens is None or not labels & set(specimen_names(node.specimens))

    return sorted(nodes, key=measured_others)


def _specimen_numbers(
    nodes: list[Node], served: list[_Served]
) -> tuple[list[NDArray[np.intp]], int]:
    """Return the specimens of each condition, those of the calibration by their numbers.

    Returns
    -------
    numbers : list of ndarray of int, shapes (n,)
        By condition.
    more : int
        How many specimens are not of the calibration.
    """
    own, total = specimens(nodes)
    known = _known_specimens(nodes, own)
    group_of = _groups_of(nodes)
    more = 0
    numbers = []
    for j, one in enumerate(served):
        condition = one.condition
        node = nodes[one.simulator]
        measured = node.target.observed
        if data_digest(condition.measured) == data_digest(measured):
            numbers.append(_matched(condition.measured, measured, own[one.simulator]))
            continue
        group = group_of[one.simulator]
        # Without labels every value is of a new specimen.
        labels = condition.labels or tuple(f"{j}, {i}" for i in range(condition.observed.size))
        for label in labels:
            if label not in known:
                known[label] = total + more, group
                more += 1
            elif known[label][1] != group:
                raise ValueError(
                    f"{condition.name}: specimens: got {label!r}, which other simulators measured "
                    f"than {node.name}, whose design points serve here; expected simulators that "
                    "share labels and .dist() objects"
                )
        numbers.append(np.array([known[label][0] for label in labels], dtype=np.intp))
    return numbers, more


def _groups_of(nodes: list[Node]) -> dict[int, int]:
    """Return the group of each simulator; the points of a group are drawn together."""
    found: dict[int, int] = {}
    for number, group in enumerate(groups(nodes)):
        found |= dict.fromkeys(group, number)
    return found


def _known_specimens(nodes: list[Node], own: list[NDArray[np.intp]]) -> dict[str, tuple[int, int]]:
    """Return number and group of the specimens of the calibration, by label."""
    group_of = _groups_of(nodes)
    known = {}
    for k, node in enumerate(nodes):
        if node.specimens is None:
            continue
        for label, number in zip(specimen_names(node.specimens), own[k], strict=True):
            known[label] = int(number), group_of[k]
    return known


def _matched(observed: Floats, measured: Floats, numbers: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the specimens of values that are those of a simulator in another order."""
    found = np.empty(len(observed), dtype=np.intp)
    found[in_order(observed)] = numbers[in_order(measured)]
    return found


def _refuse_other(condition: Condition, values: Floats, weights: Floats) -> None:
    """Raise if the predicted population is not that at the optimum."""
    predicted = condition.predicted[~np.isnan(condition.predicted)]
    # Between these a distribution function moves by .05, half of what is a difference.
    at = np.quantile(predicted, np.linspace(0.05, 0.95, 19), method="nearest")
    expected = Predictive(values, weights).transform(at, None)
    got = Predictive(condition.predicted).transform(at, None)
    apart = np.abs(expected - got).max()
    # 500 random samples of a population differ from it by .06 at 5%, and those of `predict` by far
    # less; a normal population a quarter of a standard deviation away differs by .1.
    if apart > 0.1:
        raise ValueError(
            f"{condition.name}: predicted: got values whose distribution function differs by "
            f"{apart:.2f} from that of the population at the optimum, expected "
            "prb.predict(optimum, response, *inputs) of the same condition; for another condition "
            "than a simulator's pass responses="
        )
