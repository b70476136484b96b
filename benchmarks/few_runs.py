"""How many runs calibrate several inputs with an emulator, how exact is the optimum, and is that known?

Every input has a mean and a standard deviation of its own. Responses are those of
`benchmarks.responses`, with as many outputs again that each follow one input, so that the data
identify all hyperparameters; N = 50 specimens, compared by `Joint(KullbackLeibler())`. Priors of
means are two population standard deviations wide, of standard deviations a factor of 1.6; the frame
has uniform priors a hundred posterior standard deviations wide, and is there again with inputs that
correlate, by .6, of which the prior knows nothing.

The design begins with 32 runs an input and grows by itself. The reference is the optimum of
Resimulated(65 536) on the same data. Beside it: runs alone, without an emulator, which may grow to
32 768. Off is the root mean square distance of an optimum from the reference, over hyperparameters and seeds
of designs, in standard errors; of optima that a result names as ones that the data do not tell
apart, the nearest counts. Worst is that along the worst principal axis of the sampling distribution,
times the root of two, as between two designs: what is claimed of it is `Optimum.design_error`.
Standard errors are compared with those of the reference, as root mean square ratios.

    uv run python -m benchmarks.few_runs --cells "*emulated"
    uv run python -m benchmarks.few_runs --cells "*alone" --data-sets 2
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import prbayes as prb
from benchmarks.responses import RESPONSES, Response
from benchmarks.study import Study

NAMES = ("product", "frame", "three inputs", "correlated frame")
N = 50
FIRST = 32  # runs for each input
RHO = 0.6  # correlation of the inputs of the correlated frame


def response_of(name: str) -> Response:
    """Return the response of a problem."""
    return RESPONSES[name.removeprefix("correlated ")]


def displayed_outputs(name: str) -> Callable[..., Any]:
    """Return the response with an output for each input beside its own: inputs -> (..., m).

    Correlated inputs are one argument.
    """
    response = response_of(name)

    def together(*inputs: Any) -> Any:
        x = inputs[0] if len(inputs) == 1 else np.stack(np.broadcast_arrays(*inputs), axis=-1)
        flat = x.reshape(-1, response.d)
        own = response(flat)
        if response.name != "frame":
            z = (flat - response.mean) / response.sd
            own = np.concatenate([own, z + 0.2 * z * z[:, ::-1]], axis=1)
        return own.reshape(*x.shape[:-1], own.shape[1])

    return together


def observed_of(name: str, seed: int) -> Any:
    """Return outputs of specimens of the true population, without those that have none."""
    response = response_of(name)
    rng = np.random.default_rng([seed, N])
    z = rng.standard_normal((2 * N, response.d))
    if name.startswith("correlated"):
        z[:, 1] = RHO * z[:, 0] + np.sqrt(1 - RHO**2) * z[:, 1]
    x = response.mean + response.sd * z
    found = displayed_outputs(name)(x)
    return found[np.isfinite(found).all(axis=1)][:N]


def build(name: str, observed: Any, propagation: Any) -> pm.Model:
    """Return the model."""
    response = response_of(name)
    with pm.Model() as model:
        inputs, means, sds = [], [], []
        for i, (mean, sd) in enumerate(zip(response.mean, response.sd, strict=True)):
            if response.name == "frame":
                half = 50 * sd / np.sqrt(N)
                mu = pm.Uniform(f"mu{i}", mean - half, mean + half)
                sigma = pm.Uniform(f"sigma{i}", 0, 100 * sd / np.sqrt(2 * N))
            else:
                mu = pm.Normal(f"mu{i}", mean, 2 * sd)
                sigma = pm.LogNormal(f"sigma{i}", np.log(sd), 0.5)
            means.append(mu)
            sds.append(sigma)
            inputs.append(pm.Normal.dist(mu, sigma))
        if name.startswith("correlated"):
            rho = pm.Uniform("rho", -1, 1)
            both = rho * sds[0] * sds[1]
            covariance = pt.stacklists([[sds[0] ** 2, both], [both, sds[1] ** 2]])
            inputs = [pm.MvNormal.dist(pt.stack(means), covariance)]
        metric = prb.Joint(prb.KullbackLeibler())
        outputs = displayed_outputs(name)
        prb.Simulator(
            "y", outputs, *inputs, metric=metric, observed=observed, propagation=propagation
        )
    return model


def fitted(name: str, observed: Any, propagation: Any, reference: Any) -> dict[str, Any]:
    """Calibrate once, and say how far from the reference."""
    clock = time.perf_counter()
    try:
        optimum = prb.minimize(build(name, observed, propagation))
    except prb.propagation.DesignError as error:
        return {"refused": str(error)[:200]}
    stderr = np.sqrt(np.diag(reference.covariance))
    along = along_axes(reference)
    others = [other["theta"] for other in optimum.local_optima if other["comparable"]]
    each = [(theta - reference.theta) / stderr for theta in (optimum.theta, *others)]
    away = min(each, key=lambda off: np.nansum(off**2))
    widths = np.sqrt(np.diag(optimum.covariance)) / stderr
    return {
        "runs": optimum.n_responses,
        "mirrored": away is not each[0],
        "along": [round(float(x), 4) for x in along @ np.nan_to_num(away * stderr)],
        "off": [round(float(a), 4) for a in away[np.isfinite(away)]],
        "stderr": [round(float(a), 4) for a in widths[np.isfinite(widths)]],
        "claimed": float(optimum.design_error),
        "seconds": round(time.perf_counter() - clock, 1),
    }


def along_axes(reference: Any) -> Any:
    """Return what turns steps of hyperparameters into standard errors along principal axes, (d, d).

    Of the sampling covariance in units of the prior's spread, as `Optimum.design_error` has them.
    """
    prior_sd = reference.evaluator.hyperparameters.prior_sd
    covariance = np.where(np.isfinite(reference.covariance), reference.covariance, 0.0)
    variances, axes = np.linalg.eigh(covariance / np.outer(prior_sd, prior_sd))
    known = variances > 0
    return (axes[:, known] / np.sqrt(variances[known])).T / prior_sd


@cache
def reference_of(name: str) -> prb.Optimum:
    """Return the optimum of resimulated responses."""
    observed = observed_of(name, 1)
    stored = prb.Reweighted(first_runs(name), emulator="auto", random_seed=1000)
    begin = prb.minimize(build(name, observed, stored))
    resimulated = build(name, observed, prb.Resimulated(65_536))
    return prb.minimize(resimulated, start=begin.point, starts=0)


def first_runs(name: str) -> int:
    """Return the number of runs of the first design."""
    return FIRST * response_of(name).d


def row(cell: str, seed: int) -> dict[str, Any]:
    """Return the row of a design: with an emulator, or of runs alone."""
    name, way = cell.split(", ")
    stored = prb.Reweighted(first_runs(name), emulator="auto", random_seed=seed)
    if way == "alone":
        stored = prb.Reweighted(1024, emulator=None, max_points=32_768, random_seed=seed)
    return fitted(name, observed_of(name, 1), stored, reference_of(name))


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return runs, error and its claim, and seconds, of several designs; nothing of none."""
    good = [row for row in rows if "off" in row]
    if not good:
        return {}
    runs = sorted(row["runs"] for row in good)
    off, along = (np.array([row[key] for row in good]) for key in ("off", "along"))
    # Standard errors at another optimum are its own.
    own = [row["stderr"] for row in good if not row["mirrored"]]
    return {
        "runs": [runs[0], runs[-1]],
        "off": float(np.sqrt((off**2).mean())),
        "worst": float(np.sqrt(2 * (along**2).mean(axis=0).max())),
        "claimed": float(np.sqrt(np.mean([row["claimed"] ** 2 for row in good]))),
        "widths": float(np.sqrt((np.log(own) ** 2).mean())),
        "seconds": float(np.median([row["seconds"] for row in good])),
        "refused": len(rows) - len(good),
    }


CELLS = [f"{name}, {way}" for name in NAMES for way in ("emulated", "alone")]
STUDY = Study("few_runs", __doc__, CELLS, row, 10, summary)

if __name__ == "__main__":
    STUDY.main()
