"""How does the crack growth rate vary from specimen to specimen? Calibration on 21 measured cracks.

The crack length of 21 specimens after 50 000 load cycles calibrates the population of the
coefficient C of Paris' law, lognormal, with its exponent held at 2.6: by the optimiser and the posterior,
with the log-likelihood by specimen and each metric. An independent reference fits C to every specimen's whole record by least squares.

Run: uv run python examples/crack_growth.py [--out FOLDER]
"""

import argparse
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pymc as pm
from scipy.optimize import least_squares

import prbayes as prb

EXPONENT = 2.6
METRICS = {
    "by specimen": prb.LogLikelihood(),
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "kernel log-likelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
}


def growth(C, m, million_cycles=0.05):
    """Crack length relative to the notch by Paris' law; +inf where the specimen has failed."""
    left = 1 - (m - 1) * C * million_cycles
    return np.where(left > 0, np.maximum(left, 1e-12) ** (-1 / (m - 1)), np.inf)


def reference(data):
    """Fit C to each specimen's readings by least squares; return log C, shape (specimens,)."""
    cycles = data.million_cycles.values
    found = []
    for lengths in data.crack_length_inch.values / data.notch_inch:
        use = np.isfinite(lengths) & (cycles > 0)

        def residuals(log_c, lengths=lengths, use=use):
            left = 1 - (EXPONENT - 1) * np.exp(log_c[0]) * cycles[use]
            return np.maximum(left, 1e-3) ** (-1 / (EXPONENT - 1)) - lengths[use]

        found.append(least_squares(residuals, [1.0]).x[0])
    return np.array(found)


def calibrate(metric, observed):
    """Return the model, its optimum and its posterior."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.1, 0.5)  # mean of log C
        sigma = pm.HalfNormal("sigma", 0.5)  # standard deviation of log C
        C = pm.LogNormal.dist(mu, sigma)
        prb.Simulator("crack", growth, C, EXPONENT, metric=metric, observed=observed)
    optimum = prb.minimize(model)
    posterior = prb.sample(
        1000, chains=4, model=model, optimum=optimum, random_seed=1, progressbar=False
    )
    return model, optimum, posterior


def picture(observed, log_c, results, path):
    """Save the measured and calibrated distributions, and the posteriors, as one figure."""
    colors = dict(
        zip(results, ["#0072B2", "#009E73", "#D55E00", "#CC79A7", "#E69F00"], strict=True)
    )
    figure, axes = plt.subplot_mosaic(
        [["left", "top"], ["left", "bottom"]], figsize=(11, 4.4), layout="constrained"
    )
    left = axes["left"]
    top = axes["top"]
    bottom = axes["bottom"]
    steps = np.linspace(0, 1, observed.size + 1)
    left.step(
        np.r_[observed.min(), np.sort(observed)],
        steps,
        "k",
        where="post",
        label=f"{observed.size} measured",
    )
    u = (np.arange(1000) + 0.5) / 1000
    z = pm.icdf(pm.Normal.dist(), u).eval(mode="FAST_COMPILE")
    grid = np.linspace(observed.min() - 0.05, observed.max() + 0.06, 200)
    optimum, posterior = results["by specimen"]
    draws = (
        posterior.posterior.to_dataset()
        .stack(sample=("chain", "draw"))
        .isel(sample=slice(None, None, 20))
    )
    cdfs = [
        np.searchsorted(np.sort(growth(np.exp(m + s * z), EXPONENT)), grid) / z.size
        for m, s in zip(draws.mu.values, draws.sigma.values, strict=True)
    ]
    low, high = np.quantile(cdfs, [0.055, 0.945], axis=0)
    left.fill_between(
        grid, low, high, color=colors["by specimen"], alpha=0.25, lw=0, label="posterior, 89% band"
    )
    best = growth(np.exp(optimum.point["mu"] + optimum.point["sigma"] * z), EXPONENT)
    left.plot(
        grid,
        np.searchsorted(np.sort(best), grid) / z.size,
        color=colors["by specimen"],
        label="optimum",
    )
    left.set(xlabel="crack length / notch length after 50 000 cycles", ylabel="share of specimens")
    left.legend(frameon=False, loc="upper left")
    names = {"mu": (top, log_c.mean()), "sigma": (bottom, log_c.std(ddof=1))}
    for name, (axis, least_squares_value) in names.items():
        for row, (label, (optimum, posterior)) in enumerate(results.items()):
            low, high = posterior.posterior[name].quantile([0.055, 0.945])
            axis.plot(
                [low, high], [row, row], color=colors[label], lw=3, alpha=0.5, solid_capstyle="butt"
            )
            axis.plot(posterior.posterior[name].mean(), row, "|", color=colors[label], ms=14, mew=2)
            axis.plot(optimum.point[name], row, "o", color=colors[label], mec="white", ms=8)
        axis.axvline(least_squares_value, color="k", ls=":", lw=1.2)
        axis.set(
            yticks=range(len(results)), yticklabels=list(results), ylim=(len(results) - 0.5, -0.5)
        )
    top.set(xlabel="mu: mean of log C")
    top.set_title(
        "optimum (dot); posterior mean and 89% interval (bar);\n"
        "least squares per specimen (dotted)",
        fontsize=9,
    )
    bottom.set(xlabel="sigma: standard deviation of log C")
    figure.savefig(path, dpi=150)


def main():
    """Calibrate with the likelihood and each metric, print the comparison, save the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for the figure")
    out = parser.parse_args().out
    clock = time.perf_counter()
    data = prb.datasets.crack_growth()
    observed = (data.crack_length_inch.sel(million_cycles=0.05) / data.notch_inch).values
    log_c = reference(data)
    print(
        f"{observed.size} specimens, "
        f"relative crack length {observed.min():.3f} to {observed.max():.3f}"
    )
    print(
        "reference, least squares per specimen: "
        f"mu {log_c.mean():.3f}, sigma {log_c.std(ddof=1):.3f}\n"
    )
    results = {}
    for label, metric in METRICS.items():
        model, optimum, posterior = calibrate(metric, observed)
        results[label] = optimum, posterior
        table = prb.compare({"optimum": optimum, "posterior": posterior}, model=model)
        print(f"{label}: {optimum.n_responses} responses computed")
        print(
            table[["estimate", "sd", "lower", "upper", "shift"]].to_dataframe().round(3).to_string()
        )
        print(f"{prb.diagnose(posterior, model=model)}\n")
    out.mkdir(parents=True, exist_ok=True)
    picture(observed, log_c, results, out / "crack_growth.png")
    print(f"figure: {out / 'crack_growth.png'}; {time.perf_counter() - clock:.0f} s")


if __name__ == "__main__":
    main()
