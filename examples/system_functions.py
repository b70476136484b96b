"""Case study 1 of the probability residual: four systems, one uncertain input, four metrics.

The input x is normal; its mean and standard deviation are calibrated from 1000 responses of each
system (eq. 11 to 14 of doi:10.1007/s00158-019-02288-6). Three of the four are symmetric, so that
the data could come from a mirror image of the population as well: the optimiser starts near one of
them.

Run: uv run python examples/system_functions.py [--out FOLDER]
"""

import argparse
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pymc as pm

import prbayes as prb

METRICS = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "log-likelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
}


def elliptical(x, coin):
    """The upper or the lower branch of an ellipse, as a coin falls; NaN where x is outside."""
    with np.errstate(invalid="ignore"):
        return 10 + np.where(coin < 0.5, -16, 16) * np.sqrt(1 - (x - 2) ** 2)


# Response, true and initial mean and standard deviation. The paper states no values.
SYSTEMS = {
    "linear": (lambda x: 0.75 * x, (10, 1), (9, 1.5)),
    "nonlinear A": (lambda x: x**2 - 2 * x + 1, (2, 0.5), (2.3, 0.8)),
    "nonlinear B": (lambda x: np.exp(-1 / (1 + 100 * x**2)), (0.1, 0.03), (0.13, 0.05)),
    "elliptical": (elliptical, (1.5, 0.1), (1.65, 0.15)),
}


def calibrate(response, observed, initial, metric, coins):
    """Return the optimum of the mean and the standard deviation of x."""
    with pm.Model():
        mu = pm.Normal("mu", initial[0], initial[1])
        sigma = pm.HalfNormal("sigma", initial[1])
        inputs = [pm.Normal.dist(mu, sigma), *(pm.Uniform.dist(0, 1) for _ in range(coins))]
        prb.Simulator(
            "y",
            response,
            *inputs,
            metric=metric,
            observed=observed,
            propagation=prb.Resimulated(4096),
        )
        return prb.minimize(start={"mu": initial[0], "sigma": initial[1]})


def main():
    """Calibrate each system with each metric, print a table, save a figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for the figure")
    out = parser.parse_args().out
    clock = time.perf_counter()
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.2), layout="constrained")
    print(
        f"{'system':12s} {'metric':15s} {'mean':>8s} {'error %':>8s} "
        f"{'sd':>8s} {'error %':>8s} {'evaluations':>12s}"
    )
    for axis, (name, (response, truth, initial)) in zip(axes, SYSTEMS.items(), strict=True):
        rng = np.random.default_rng(5)
        coins = int(response is elliptical)
        coin = [rng.random(2000)] * coins
        observed = response(rng.normal(*truth, 2000), *coin)
        observed = observed[np.isfinite(observed)][
            :1000
        ]  # a specimen outside the ellipse cannot be measured
        for label, metric in METRICS.items():
            optimum = calibrate(response, observed, initial, metric, coins)
            found = np.array([optimum.point["mu"], optimum.point["sigma"]])
            error = 100 * np.abs(found / truth - 1)
            row = f"{found[0]:8.4f} {error[0]:8.2f} {found[1]:8.4f} {error[1]:8.2f}"
            row += f" {optimum.search.n_evaluations:12d}"
            print(
                f"{name:12s} {label:15s} {row}"
                f"{'' if optimum.converged else '  ' + optimum.message}",
                flush=True,
            )
            if label == "PR":
                calibrated = response(rng.normal(*found, 20_000), *([rng.random(20_000)] * coins))
                lost = np.isnan(calibrated).mean()
                before = response(rng.normal(*initial, 20_000), *([rng.random(20_000)] * coins))
        if coins:
            print(f"{'':12s} share of the calibrated population without response: {lost:.2%}")
        bins = np.linspace(*np.quantile(before[np.isfinite(before)], [0.002, 0.998]), 60)
        axis.hist(observed, bins, density=True, color="0.8", label="1000 measured")
        for values, style, text in (
            (before, "--", "initial"),
            (calibrated, "-", "calibrated by PR"),
        ):
            density, _ = np.histogram(values[np.isfinite(values)], bins, density=True)
            axis.stairs(density, bins, ls=style, color="#0072B2", label=text)
        axis.set(title=name, xlabel="response")
    axes[0].set_ylabel("density")
    axes[0].legend(frameon=False, fontsize=8)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "system_functions.png", dpi=110)
    print(f"figure: {out / 'system_functions.png'}; {time.perf_counter() - clock:.0f} s")


if __name__ == "__main__":
    main()
