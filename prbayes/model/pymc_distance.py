"""`abc_distance`: a metric as the ``distance=`` of a stock `pymc.Simulator`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op

from prbayes._validate import Floats, called
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.model.random_variable import log_kernel


class abc_distance(Op):  # noqa: N801 (reads as a function in a model)
    """Turn a metric into the ``distance=`` of a stock `pymc.Simulator`.

    Parameters
    ----------
    metric : Metric

    Raises
    ------
    TypeError
        If ``metric`` is not a metric object.

    Notes
    -----
    `pymc.Simulator` draws new responses at every evaluation, each given to all observations;
    numbers of simulated and observed responses may differ. A simulated sample with NaN has
    log-density -inf.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> def simulate(rng, mu, size):
    ...     return rng.normal(mu, 1.0, size=500)
    >>> with pm.Model() as model:
    ...     distance = prb.abc_distance(prb.AreaMetric())
    ...     y = pm.Simulator("y", simulate, pm.Normal("mu"), distance=distance,
    ...                      epsilon=0.02, observed=np.array([0.5, 1.0, 4.0]))
    """

    __props__ = ("metric",)
    gufunc_signature = "(),(n),(m)->()"

    def __init__(self, metric: Metric) -> None:
        if not isinstance(metric, Metric):
            raise TypeError(
                f"abc_distance: got {called(metric)}, expected a metric object "
                "such as prb.AreaMetric()"
            )
        self.metric = metric
        self._prepared: tuple[Floats, Discrepancy] | None = None

    def make_node(self, epsilon: Any, observed: Any, simulated: Any) -> Apply[Any, Any]:
        """Apply to epsilon and the two samples."""
        tensors = [pt.as_tensor(v) for v in (epsilon, observed, simulated)]
        return Apply(self, tensors, [pt.dscalar()])

    def perform(self, node: Any, inputs: Sequence[Any], outputs: Any) -> None:
        """Return the log-density; the observed side is prepared once."""
        epsilon, observed, simulated = inputs
        if self._prepared is None or not np.array_equal(self._prepared[0], observed):
            self._prepared = (np.array(observed), self.metric.against(observed))
        _, target = self._prepared
        value = -np.inf
        if not (np.isnan(simulated) | np.isneginf(simulated)).any():
            value = log_kernel(target(simulated), epsilon)
        outputs[0][0] = np.asarray(value, dtype=np.float64)
