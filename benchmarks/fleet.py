"""Many products with a population each: one emulator, and a posterior for each product.

The points of all specimens come in blocks from the emulator of the first products. A posterior is
importance sampling on `PopulationDensity`, around modes that are found in blocks. `benchmarks.speed` measures it on the frame.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np

from prbayes.model.specimen_preparation import prepared

OF_EMULATOR = 10  # products whose specimens place the runs
BLOCK = 50  # products whose points are drawn at once
DRAWS = 256


def fleet(products: int, size: int = 20) -> dict[str, Any]:
    """Return CPU seconds of points and posteriors, and the errors of the posteriors."""
    from benchmarks.scoreboard.problem import Response
    from benchmarks.scoreboard.problems import PROBLEMS
    from benchmarks.scoreboard.rivals.prbayes import likelihood_model
    from benchmarks.scoreboard.study import Task
    from prbayes.metrics.readings import Readings
    from prbayes.model.evaluator import Evaluator
    from prbayes.posterior.importance import importance_sample, laplace
    from prbayes.propagation.population_density import PopulationDensity, WeightedPoints
    from prbayes.propagation.specimen_emulation import specimen_roots
    from prbayes.propagation.specimen_points import draw_points

    problem = PROBLEMS["frame"]
    data = [problem.data(size, r) for r in range(products)]
    begun = time.process_time()
    response = Response(problem)
    observed = np.concatenate(data[:OF_EMULATOR])
    evaluator = Evaluator.of(likelihood_model(Task(problem, observed, response, 0)))
    (likelihood,) = evaluator.likelihoods
    emulation, coordinates = prepared(likelihood).emulation, likelihood.coordinates
    fitted = time.process_time()
    x, log_a = [], []
    for first in range(0, products, BLOCK):
        readings = Readings.exact(np.concatenate(data[first : first + BLOCK]))
        roots = specimen_roots(emulation, readings, likelihood.options)
        points = draw_points(emulation, readings, roots, likelihood.options)
        block = min(BLOCK, products - first)
        inputs = [v.reshape(block, size, -1) for v in coordinates.inputs(points.z)]
        x += list(zip(*inputs, strict=True))
        logs = points.log_a + coordinates.log_jacobian(points.z)
        log_a += list(logs.reshape(block, size, -1))
    drawn = time.process_time()
    names = evaluator.hyperparameters
    density = PopulationDensity(likelihood.inputs)
    order = [str(root.name) for root in likelihood.inputs.parents]
    free = [str(rv.name) for rv in evaluator.model.free_RVs]
    weighted = [WeightedPoints.of(likelihood.inputs, *each) for each in zip(x, log_a, strict=True)]

    def log_posteriors(thetas: Any, members: range) -> Any:
        """Return log-densities of equal parts of the thetas, a part for each product."""
        values = names.constrained(thetas)
        params = [np.split(values[name], len(members)) for name in order]
        logs = [
            density.log_likelihoods(part, weighted[r]).sum(axis=1)
            for r, part in zip(members, zip(*params, strict=True), strict=True)
        ]
        return names.log_prior(thetas) + np.concatenate(logs)

    means, sds = [], []
    for first in range(0, products, BLOCK):
        members = range(first, min(first + BLOCK, products))
        # The moments of the points are near the mode.
        medians = [
            [np.nanmedian(np.where(np.isfinite(log_a[r]), v, np.nan), axis=1) for v in x[r]]
            for r in members
        ]
        means_of, sds_of = np.mean(medians, axis=2).T, np.std(medians, axis=2).T
        start = dict(zip(("mu1", "mu2", "sd1", "sd2"), (*means_of, *sds_of), strict=True))
        starts = names.thetas_of([start[name] for name in free])
        modes = laplace(partial(log_posteriors, members=members), starts, names.prior_sd)
        for r, mode in zip(members, modes, strict=True):
            log_posterior = partial(log_posteriors, members=range(r, r + 1))
            sample = importance_sample(log_posterior, [mode], DRAWS, r)
            values = names.constrained(sample.draws)
            means.append([values[name].mean() for name in problem.priors])
            sds.append([values[name].std() for name in problem.priors])
    done = time.process_time()
    checked = range(min(products, 100))
    references = [problem.reference(size, r) for r in checked]
    center = np.array([[ref.center[name] for name in problem.priors] for ref in references])
    unit = np.array([[ref.sd[name] for name in problem.priors] for ref in references])
    bias = (np.array(means)[: len(checked)] - center) / unit
    widths = (np.array(sds)[: len(checked)] / unit).mean(axis=0)
    return {
        "cold": done - begun,
        "emulator": fitted - begun,
        "points": drawn - fitted,
        "posteriors": done - drawn,
        "runs": response.runs,
        "bias": float(np.sqrt((bias**2).mean(axis=0)).max()),
        "width": float(max(widths, key=lambda width: abs(np.log(width)))),
    }
