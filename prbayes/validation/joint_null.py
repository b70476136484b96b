"""Null distribution of the area test on the specimens of the calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats, called, positive_integer
from prbayes.inference.refits import SamplingDistribution, refit
from prbayes.inference.resampling import groups, sets_at, simulated_points, specimens
from prbayes.model.evaluator import shortcomings
from prbayes.model.fingerprint import Level, require_same
from prbayes.model.random_variable import Node
from prbayes.optimize.optimum import Optimum, require_refits
from prbayes.propagation.base import DesignError
from prbayes.propagation.reweighted import PoorEmulatorError, designs_restored
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses, refuse_uncallable
from prbayes.results.predict import data_digest, in_order, serving, specimen_names
from prbayes.validation.conditions import Case, Condition
from prbayes.validation.nulls import LEAST_REPLICATES, Judgement, Null, judge_by_replicates
from prbayes.validation.probability_transform import Predictive


@dataclass(frozen=True)
class JointNull(Null):
    """Calibration and test data come together from the calibrated model.

    The model is recalibrated in each replicate.

    For tests on the calibration's own specimens, under the same conditions or others: a model that
    was fitted to them follows them more closely than fresh ones. Each replicate draws specimens
    from the population at the optimum, minimises the discrepancy for their calibration data, and
    tests their responses against that population. The predicted population is that of
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
    random_seed : int

    Raises
    ------
    TypeError
        If ``optimum`` is no Optimum, or a response cannot be called.
    ValueError
        If a metric or propagation does not allow refits (`FunctionMetric`, `Fresh`); if the prior
        was part of the optimum, or its model has changed since.

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
        advice = "; the model cannot be calibrated anew: use prb.validation.PosteriorNull()"
        require_refits(self.optimum, "JointNull", advice)
        _require_responses(self.responses)
        positive_integer(self.replicates, "JointNull: replicates", minimum=LEAST_REPLICATES)
        positive_integer(self.random_seed, "JointNull: random_seed", minimum=0)

    def judge(self, case: Case, statistic: float, alpha: float) -> Judgement:
        """Count the observed data among the replicates."""
        return judge_by_replicates([self._u_values(case)], case, statistic, alpha)

    def describe(self, case: Case) -> str:
        """Return the null hypothesis in a phrase."""
        return (
            "calibration and test data come from the calibrated model, which is calibrated anew in "
            "each replicate"
        )

    def _u_values(self, case: Case) -> Floats:
        """Return u-values of the replicates, (r, n)."""
        require_same(case.identity, self.optimum.identity, "JointNull: predicted", Level.OPTIMUM)
        evaluator = self.optimum.evaluator
        sampling = self.optimum.sampling()
        bounds = evaluator.reweighted.values()
        with designs_restored(bounds):
            try:
                tested = [self._tested(case, condition) for condition in case.conditions]
            except PoorEmulatorError as error:
                # All responses at the same points: those of the runs.
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
        evaluator, theta = self.optimum.evaluator, self.optimum.theta
        rng_of_ties = case.rng(1)
        numbers, n_new = _specimen_numbers(evaluator.nodes, tested)
        populations = [evaluator.populations(theta[None], k) for k in range(len(evaluator.nodes))]
        for t in tested:
            responses, weights = populations[t.simulator]
            t.require_population(responses[0], weights[0])

        points = simulated_points(
            evaluator, populations, self.replicates, self.random_seed, more=n_new
        )
        x, converged = refit(sampling, sets_at(evaluator, populations, points))
        # With fewer the replicates would be those of unusual data sets.
        if converged.mean() < 0.5:
            raise ValueError(
                f"JointNull: got {converged.mean():.0%} of the minimisations converged, expected "
                "most; look at prb.diagnose(optimum)"
            )
        thetas = sampling.thetas(x[converged])

        u = []
        for t, number in zip(tested, numbers, strict=True):
            drawn = points[t.simulator][converged][:, number]
            project = t.condition.projection.of
            measured = project(t.values_or(populations[t.simulator][0][0])[drawn])
            refitted, weights = evaluator.populations(thetas, t.simulator)
            values = np.broadcast_to(project(t.values_or(refitted)), weights.shape)
            rows = [
                Predictive(row, weight).transform(y, rng_of_ties)
                for row, weight, y in zip(values, weights, measured, strict=True)
            ]
            u.append(np.array(rows))
        joined = np.concatenate(u, axis=1)
        return np.asarray(joined[~np.isnan(joined).any(axis=1)])

    def _tested(self, case: Case, condition: Condition) -> _Tested:
        """Return a condition with the simulator whose points are its specimens."""
        if condition.predicted.shape[0] > 1:
            raise ValueError(
                f"{condition.name}: predicted: got {len(condition.predicted)} draws, expected the "
                "one population at the optimum, which JointNull calibrates anew; pass "
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
        refuse_uncallable(condition.name, response)
        roots = read_inputs(condition.name, inputs, self.optimum.model)
        responses = Responses(condition.name, response, roots, outputs=None)
        labels = set(condition.labels or ())

        def lacks_specimens(node: Node) -> bool:
            return node.specimens is None or not labels & set(specimen_names(node.specimens))

        measuring_first = sorted(nodes, key=lacks_specimens)
        node = serving(measuring_first, responses)
        if node is None:
            raise ValueError(
                f"{condition.name}: responses: got inputs that no simulator with prb.Reweighted "
                "has, expected its .dist() objects; only then is it known which responses belong "
                "to the specimens of the calibration"
            )
        assert node.reweighted is not None
        return _Tested(condition, nodes.index(node), node.reweighted.values_of(responses))


def _require_responses(responses: object) -> None:
    """Raise if they are neither a tuple of a response and its inputs, nor several by condition."""
    if responses is None:
        return
    pairs = list(responses.values()) if isinstance(responses, Mapping) else [responses]
    if not pairs or not all(isinstance(p, tuple) and p and callable(p[0]) for p in pairs):
        raise TypeError(
            f"JointNull: responses: got {called(responses)}, expected a tuple (response, *inputs), "
            "or a mapping of conditions to such"
        )


@dataclass(frozen=True, eq=False)
class _Tested:
    """A condition, and the simulator whose points are its specimens."""

    condition: Condition
    simulator: int
    values: Floats | None  # (points,): responses at the simulator's points; None: the simulator's

    def values_or(self, responses: Floats) -> Floats:
        """Return the tested responses at points where the simulator has these."""
        return responses if self.values is None else self.values

    def require_population(self, responses: Floats, weights: Floats) -> None:
        """Raise if the predicted population is not that at the optimum."""
        condition = self.condition
        predicted = condition.predicted[~np.isnan(condition.predicted)]
        # Between these a distribution function moves by .05, half of the smallest difference.
        at = np.quantile(predicted, np.linspace(0.05, 0.95, 19), method="nearest")
        values = condition.projection.of(self.values_or(responses))
        expected = Predictive(values, weights).transform(at, None)
        got = Predictive(condition.predicted).transform(at, None)
        largest = np.abs(expected - got).max()
        # 500 random samples of a population differ from it by .06 at 5%, and those of `predict` by
        # far less; a normal population a quarter of a standard deviation away differs by .1.
        if largest > 0.1:
            raise ValueError(
                f"{condition.name}: predicted: got values whose distribution function differs by "
                f"{largest:.2f} from that of the population at the optimum, expected "
                "prb.predict(optimum, response, *inputs) of the same condition; for another "
                "condition than a simulator's pass responses="
            )


def _specimen_numbers(
    nodes: Sequence[Node], tested: list[_Tested]
) -> tuple[list[NDArray[np.intp]], int]:
    """Return the numbers of each condition's specimens, (n,), and how many are new.

    Specimens of the calibration have their numbers there.
    """
    node_numbers, total = specimens(nodes)
    # The points of a group of simulators are drawn together.
    group_of = {k: i for i, members in enumerate(groups(nodes)) for k in members}
    number_and_group: dict[str, tuple[int, int]] = {}
    for k, node in enumerate(nodes):
        if node.specimens is not None:
            for label, number in zip(specimen_names(node.specimens), node_numbers[k], strict=True):
                number_and_group[label] = int(number), group_of[k]
    n_new = 0
    numbers = []
    for j, t in enumerate(tested):
        condition, node = t.condition, nodes[t.simulator]
        calibrated = node.target.observed
        if data_digest(condition.measured) == data_digest(calibrated):
            # The same values, perhaps in another order.
            matched = np.empty(len(calibrated), dtype=np.intp)
            matched[in_order(condition.measured)] = node_numbers[t.simulator][in_order(calibrated)]
            numbers.append(matched)
            continue
        group = group_of[t.simulator]
        # Without labels every value is of a new specimen.
        labels = condition.labels or tuple(f"{j}, {i}" for i in range(condition.observed.size))
        for label in labels:
            if label not in number_and_group:
                number_and_group[label] = total + n_new, group
                n_new += 1
            elif number_and_group[label][1] != group:
                raise ValueError(
                    f"{condition.name}: specimens: got {label!r}, which other simulators measured "
                    f"than {node.name}, whose design points serve here; expected simulators that "
                    "share labels and .dist() objects"
                )
        numbers.append(np.array([number_and_group[label][0] for label in labels], dtype=np.intp))
    return numbers, n_new
