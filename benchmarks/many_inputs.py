"""Eight inputs with sixteen hyperparameters from four outputs of 50 specimens, by `prb.sample`.

The log-likelihood by specimen has an emulator. The reference has other points of the response
itself: four independent sets of 1024 a specimen, which
reweight the draws. Bias and width are those of the sixteen hyperparameters, in standard deviations
of the reference; its own error is that of the mean of the sets.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.many_inputs [--data-sets 3]
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
from scipy.special import logsumexp

import prbayes as prb
from benchmarks.responses import RESPONSES
from benchmarks.study import Study
from prbayes.model.evaluator import Evaluator
from prbayes.model.specimen_preparation import (
    CheckedRuns,
    PopulationDraws,
    SpecimenPopulations,
    prepared,
    specimen_data,
)
from prbayes.specimens.emulation import DifferencedResponse
from prbayes.specimens.points import draw_points, fit_proposals, normal_of

RESPONSE = RESPONSES["eight inputs"]
N, SETS, POINTS = 50, 4, 1024


def build(seed: int) -> pm.Model:
    """Return the model with the data of a seed; the priors are off by .3 standard deviations."""
    z = np.random.default_rng([seed, N]).standard_normal((N, RESPONSE.d))
    observed = RESPONSE.of_columns(*(RESPONSE.mean + RESPONSE.sd * z).T)
    with pm.Model() as model:
        inputs = []
        for i, (mean, sd) in enumerate(zip(RESPONSE.mean, RESPONSE.sd, strict=True)):
            mu = pm.Normal(f"mu{i}", mean + 0.3 * sd, sd)
            inputs.append(pm.Normal.dist(mu, pm.LogNormal(f"sigma{i}", np.log(sd) + 0.1, 0.3)))
        prb.Simulator("y", RESPONSE.of_columns, *inputs, observed=observed)
    return model


def measured(seed: int, sets: int = SETS, points: int = POINTS) -> dict[str, Any]:
    """Return runs, CPU seconds, bias and width of the posterior of a data set."""
    model = build(seed)
    begun = time.process_time()
    idata = prb.sample(500, model=model, random_seed=seed, progressbar=False)
    seconds = time.process_time() - begun
    evaluator = Evaluator.of(model)
    (likelihood,) = evaluator.likelihoods
    thetas = evaluator.hyperparameters.thetas_of(
        [idata.posterior[rv.name].values.reshape(-1) for rv in model.free_RVs]
    )
    populations = SpecimenPopulations(likelihood)
    reference = normal_of(PopulationDraws(populations, thetas[::8]).specimens(), 1.2)
    data = specimen_data(likelihood)
    exact = replace(
        prepared(likelihood).emulation,
        surface=DifferencedResponse(CheckedRuns(likelihood)),
        y=np.zeros_like(prepared(likelihood).emulation.y),
        error=data.options.floor * data.readings.spread(),
    )
    proposals = fit_proposals(data, exact, reference)
    logs = []
    for s in range(sets):
        drawn = draw_points(data, proposals, points, 700 + s)
        logs.append(populations.log_likelihoods(thetas, drawn.z, drawn.log_a).sum(axis=1))
    stored = prepared(likelihood).points
    own = populations.log_likelihoods(thetas, stored.z, stored.log_a).sum(axis=1)
    log_weights = logsumexp(logs, axis=0) - own
    weights = np.exp(log_weights - logsumexp(log_weights))
    mean = weights @ thetas
    sd = np.sqrt(weights @ (thetas - mean) ** 2)
    bias = (thetas.mean(axis=0) - mean) / sd
    return {
        "data": seed,
        "runs": len(prepared(likelihood).emulation.z),
        "points": stored.z.shape[1],
        "sampler": idata.posterior.attrs["sampler"],
        "seconds": round(seconds, 1),
        "bias": bias.tolist(),
        "width": (thetas.std(axis=0) / sd).tolist(),
        "error of log L": float(log_weights.std()),
        "error of the reference": float(np.std(logs, axis=0).mean() / np.sqrt(sets)),
    }


def figures(row: dict[str, Any]) -> dict[str, float]:
    """Return the largest and the root mean square bias, and the extreme widths, of a data set."""
    bias, width = np.abs(row["bias"]), np.array(row["width"])
    return {
        "runs": row["runs"],
        "seconds": row["seconds"],
        "largest": float(bias.max()),
        "rms": float(np.sqrt((bias**2).mean())),
        "narrowest": float(width.min()),
        "widest": float(width.max()),
    }


STUDY = Study("many_inputs", __doc__, ["eight inputs"], lambda _, number: measured(number + 1), 3)

if __name__ == "__main__":
    STUDY.main()
