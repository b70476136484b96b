"""How many runs of the rotor does a calibration need, with a surrogate and without one, and what error is left?

The contact stiffness of examples/rotor is calibrated from 15 crest factors by PR, with the
populations of bearing stiffness and damping known: three inputs. The error is that of the optimum
(root mean square over both hyperparameters and four designs) in standard errors, against a
reference with 16384 runs and no surrogate. At the end, the fit of the first natural frequency to
its stated distribution for two families of stiffness.

Run: uv run python -m benchmarks.surrogate
"""

import logging
import sys
import time
from pathlib import Path

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record

ROOT = Path(__file__).parent
sys.path.insert(0, str(ROOT.parent / "examples" / "rotor"))

from rotor import crest_factor, first_frequency  # noqa: E402
from two_step import CREST, FREQUENCY, METRICS, RANGES, moments, stated_values, synthetic_tests  # noqa: E402

DESIGNS = 4


def calibrate(response, propagation, *, only_contact=False):
    """Return the optimum."""
    with pm.Model() as model:
        mu, sd = pm.Normal("mu_r", 0.5, 0.3), pm.HalfNormal("sd_r", 0.3)
        contact = pm.TruncatedNormal.dist(mu, sd, lower=0)
        k, c = pm.Gamma.dist(mu=265.0, sigma=15.5), pm.Gamma.dist(mu=10.0, sigma=1.0)
        inputs = (265.0, 10.0, contact) if only_contact else (k, c, contact)
        observed = synthetic_tests(*CREST, 15, seed=2020)
        metric = METRICS["PR"]
        prb.Simulator(
            "crest", response, *inputs, metric=metric, observed=observed, propagation=propagation
        )
    return prb.minimize(model)


def surrogate_and_optimum(n, model, seed):
    """Return runs, the surrogate's relative error, and the optimum through it."""
    surrogate = prb.Surrogate.fit(crest_factor, RANGES, n, model=model, random_seed=seed)
    return (
        surrogate.n_runs,
        surrogate.error.relative,
        calibrate(surrogate, prb.Resimulated(1024, random_seed=seed)),
    )


def main():
    """Print the table, save it as JSON."""
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    clock = time.perf_counter()
    reference = calibrate(crest_factor, prb.Reweighted(16384, emulator=None, random_seed=99))
    names = ("mu_r", "sd_r")
    error = np.array([reference.stderr[n] for n in names])
    center = np.array([reference.point[n] for n in names])
    print(f"reference: {reference.n_responses} runs, {dict(zip(names, center.round(4), strict=True))}, "
          f"standard errors {error.round(4)}")  # fmt: skip
    rows = []

    def add(what, results):
        off = np.array([([o.point[n] for n in names] - center) / error for _, _, o in results])
        row = {
            "what": what, "runs": int(np.mean([r for r, _, _ in results])),
            "cross_validated": None if np.isnan(results[0][1]) else float(np.mean([e for _, e, _ in results])),
            "error": float(np.sqrt(np.mean(off**2))),
        }  # fmt: skip
        rows.append(row)
        shown = "      -" if row["cross_validated"] is None else f"{row['cross_validated']:7.2%}"
        print(f"{what:58s} {row['runs']:6d} runs  cv error {shown}  "
              f"error {row['error']:.3f} se ({time.perf_counter() - clock:.0f} s)", flush=True)  # fmt: skip

    for model, sizes in (
        (prb.surrogate.RadialBasis(), (16, 32, 64, 128)),
        (prb.surrogate.Polynomial(4), (64, 128)),
    ):
        for n in sizes:
            found = [surrogate_and_optimum(n, model, seed) for seed in range(DESIGNS)]
            add(f"surrogate, {type(model).__name__}, {n}; Resimulated(1024)", found)
    for n, emulator, what in (
        (16, "auto", "emulated between"),
        (32, "auto", "emulated between"),
        (64, "auto", "emulated between"),
        (256, None, "alone"),
        (1024, None, "alone"),
    ):
        optima = [
            calibrate(crest_factor, prb.Reweighted(n, emulator=emulator, random_seed=seed))
            for seed in range(DESIGNS)
        ]
        add(
            f"no surrogate, Reweighted({n}), runs {what}",
            [(o.n_responses, np.nan, o) for o in optima],
        )
    for n in (32, 64, 128):
        optima = [
            calibrate(crest_factor, prb.Reweighted(n, random_seed=seed), only_contact=True)
            for seed in range(DESIGNS)
        ]
        add(
            f"no surrogate, bearings at their means, Reweighted({n})",
            [(o.n_responses, np.nan, o) for o in optima],
        )
    families = {"normal": pm.Normal.dist, "gamma": lambda m, s: pm.Gamma.dist(mu=m, sigma=s)}
    fits = {}
    for name, family in families.items():
        for label, metric in METRICS.items():
            with pm.Model() as model:
                k = family(pm.Normal("mu", 266, 40), pm.HalfNormal("sd", 30))
                prb.Simulator(
                    "f",
                    first_frequency,
                    k,
                    10.55,
                    metric=metric,
                    observed=stated_values(*FREQUENCY),
                )
            mean, sd = moments(prb.minimize(model), first_frequency, (k, 10.55))
            fits[f"{name}, {label}"] = [
                float(100 * (mean / FREQUENCY[0] - 1)),
                float(100 * (sd / FREQUENCY[1] - 1)),
            ]
            mean_error, sd_error = fits[f"{name}, {label}"]
            print(
                f"stiffness {name:7s} {label:15s} error of the mean {mean_error:+.3f}%, of the sd {sd_error:+.2f}%"
            )
    path = record.RESULTS / "surrogate.json"
    record.save(path, {"rows": rows, "stated frequency, errors in %": fits})
    print(f"{path.name}; {time.perf_counter() - clock:.0f} s")


if __name__ == "__main__":
    main()
