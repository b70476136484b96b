"""`JointNull`: the area test on the very specimens of the calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats, positive_integer
from prbayes._predict import data_digest, serving, specimen_names
from prbayes.estimate.data_sets import groups, sets_at, simulated_points, specimens
from prbayes.estimate.obstacles import refit_obstacle
from prbayes.estimate.optimum import Optimum, surveyed
from prbayes.estimate.refit import SamplingDistribution
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses, refuse_uncallable
from prbayes.validation.nulls import Case, Condition, Predictive, SimulatedNull

_DIFFERENT = 0.1  # between distribution functions of predicted values and of the population at the optimum


@dataclass(frozen=True)
class JointNull(SimulatedNull):
    """Calibration and test data come together from the calibrated model, which is calibrated anew each time.

    For tests on the calibration's own specimens, under the same conditions or others: a model that was fitted
    to them follows them more closely than fresh ones. Each replicate draws specimens from the population at
    the optimum, minimises the discrepancy for their calibration data, and tests their responses against the
    population found. The predicted population is that of `predict` with the optimum. Minimisations are those of
    the parametric `bootstrap`: with `Reweighted` they compute no response.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`, without the prior.
    responses : tuple or mapping, optional
        ``(response, *inputs)`` of the tested condition, or such tuples by the names of conditions, as they were
        given to `predict`. Conditions without one are the model's simulators, by name; one condition alone is
        the only simulator.
    replicates : int
    seed : int

    Raises
    ------
    TypeError
        If ``optimum`` is no Optimum, or a response cannot be called.
    ValueError
        If nothing is known of a metric or propagation (`FunctionMetric`, `Fresh`).

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> data = [0.1, 1.2, 2.0, 2.9, 4.2]
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=data)
    >>> optimum = prb.minimize(model)
    >>> predicted = prb.predict(optimum, np.positive, x, random_seed=1)
    >>> prb.area_test(data, predicted, null=prb.JointNull(optimum, replicates=199)).rejected
    False
    """

    own_specimens: ClassVar[bool] = True

    optimum: Optimum = field(repr=False)
    responses: tuple[Any, ...] | Mapping[str, tuple[Any, ...]] | None = field(default=None, repr=False)
    replicates: int = 999
    seed: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.optimum, Optimum):
            raise TypeError(
                f"JointNull: got {type(self.optimum).__name__}, expected an Optimum; call prb.minimize() first"
            )
        reason = refit_obstacle(surveyed(self.optimum, "JointNull").evaluator)
        if reason:
            raise ValueError(f"JointNull: {reason}, so that the model cannot be calibrated anew; use PosteriorNull()")
        positive_integer(self.replicates, "JointNull: replicates", minimum=19)
        positive_integer(self.seed, "JointNull: seed", minimum=0)

    def replicates_of(self, case: Case) -> Iterator[Floats]:
        """Draw, calibrate, test."""
        evaluator, theta, ties = self.optimum.evaluator, self.optimum.theta, case.rng(1)
        found = [self._served(case, c) for c in case.conditions]
        numbers, total = self._numbers(case, [k for k, _ in found])
        populations = [evaluator.populations(theta[None], k) for k in range(len(evaluator.nodes))]
        for c, (k, values) in zip(case.conditions, found, strict=True):
            _refuse_other(c, populations[k][0][0] if values is None else values, populations[k][1][0])
        points = simulated_points(evaluator, populations, self.replicates, self.seed, more=total)
        scales = np.array(list(self.optimum.scales.values()))
        sampling = SamplingDistribution.of(evaluator, theta, scales)
        x, converged = sampling.refit(sets_at(evaluator, populations, points))
        if converged.mean() < 0.5:
            raise ValueError(
                f"JointNull: got {converged.mean():.0%} of the minimisations converged, expected most; look at "
                "prb.diagnose(optimum)"
            )
        thetas = sampling.thetas(x[converged])
        u: list[Floats] = []
        for (k, values), number in zip(found, numbers, strict=True):
            measured = (populations[k][0][0] if values is None else values)[points[k][converged][:, number]]
            refitted, weights = evaluator.populations(thetas, k)
            own = refitted if values is None else np.broadcast_to(values, weights.shape)
            rows = zip(own, weights, measured, strict=True)
            u.append(np.array([Predictive(v, w).transform(y, ties) for v, w, y in rows]))
        together = np.concatenate(u, axis=1)
        yield together[~np.isnan(together).any(axis=1)]

    def _served(self, case: Case, condition: Condition) -> tuple[int, Floats | None]:
        """Return the simulator whose points are the specimens, and responses at them unless they are its own."""
        nodes = self.optimum.evaluator.nodes
        names = [n.name for n in nodes]
        if condition.predicted.shape[0] > 1:
            raise ValueError(
                f"{condition.name}: predicted: got {len(condition.predicted)} draws, expected the one population at "
                "the optimum, which JointNull calibrates anew; pass prb.predict(optimum, ...)"
            )
        given = self.responses
        if isinstance(given, Mapping):
            given = given.get(condition.name)
        if given is None:
            if len(case.conditions) == len(nodes) == 1:
                return 0, None
            if condition.name in names:
                return names.index(condition.name), None
            raise ValueError(
                f"JointNull: got the condition {condition.name!r}, expected the name of a simulator, {names}; or pass "
                f"responses={{{condition.name!r}: (response, *inputs)}}"
            )
        response, *inputs = given
        refuse_uncallable(condition.name, response)
        sorted_inputs = read_inputs(condition.name, inputs, self.optimum.model)
        labels = set(condition.labels or ())
        # First the simulators that measured these specimens.
        among = sorted(nodes, key=lambda n: n.specimens is None or not labels & set(specimen_names(n.specimens)))
        called = Responses(condition.name, response, sorted_inputs)
        node = serving(among, called)
        if node is None:
            raise ValueError(
                f"{condition.name}: responses: got inputs that no simulator with prb.Reweighted has, expected its "
                ".dist() objects; only then is it known which responses belong to the specimens of the calibration"
            )
        assert node.design is not None
        return nodes.index(node), node.design.values_of(called)

    def _numbers(self, case: Case, served: list[int]) -> tuple[list[NDArray[np.intp]], int]:
        """Return the specimens of each condition, those of the calibration by their numbers, and how many are new."""
        nodes = self.optimum.evaluator.nodes
        own, total = specimens(nodes)
        together = {k: i for i, group in enumerate(groups(nodes)) for k in group}
        known: dict[str, tuple[int, int]] = {}  # number, and group of simulators whose points are drawn together
        for k, node in enumerate(nodes):
            if node.specimens is not None:
                known |= {s: (int(i), together[k]) for s, i in zip(specimen_names(node.specimens), own[k], strict=True)}
        more, out = 0, []
        for j, (c, k) in enumerate(zip(case.conditions, served, strict=True)):
            if data_digest(c.observed) == data_digest(nodes[k].target.observed):
                number = np.empty(c.observed.size, dtype=np.intp)
                number[np.argsort(c.observed, kind="stable")] = own[k][
                    np.argsort(nodes[k].target.observed, kind="stable")
                ]
                out.append(number)
                continue
            labels = c.labels or tuple(f"{j}, {i}" for i in range(c.observed.size))
            for label in labels:
                if label not in known:
                    known[label] = total + more, together[k]
                    more += 1
                elif known[label][1] != together[k]:
                    raise ValueError(
                        f"{c.name}: specimens: got {label!r}, which other simulators measured than {nodes[k].name}, "
                        "whose design points serve here; expected simulators that share labels and .dist() objects"
                    )
            out.append(np.array([known[label][0] for label in labels], dtype=np.intp))
        return out, more

    def describe(self, case: Case) -> str:
        """Return what is held to be true."""
        return "calibration and test data come from the calibrated model, which is calibrated anew in each replicate"


def _refuse_other(condition: Condition, values: Floats, weights: Floats) -> None:
    """Raise if the predicted population is not that at the optimum."""
    at = np.quantile(condition.predicted[~np.isnan(condition.predicted)], np.linspace(0.05, 0.95, 19), method="nearest")
    apart = np.abs(
        Predictive(values, weights).transform(at, None) - Predictive(condition.predicted).transform(at, None)
    ).max()
    if apart > _DIFFERENT:
        raise ValueError(
            f"{condition.name}: predicted: got values whose distribution function differs by {apart:.2f} from that of "
            "the population at the optimum, expected prb.predict(optimum, response, *inputs) of the same condition; "
            "for another condition than a simulator's pass responses="
        )
