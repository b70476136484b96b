"""A rotor in two steps: bearings from an impact test, rub from crest factors; then judged.

Step 1 calibrates the population of bearing stiffness and damping from 15 first natural frequencies,
N(45.69, 0.19) Hz. Step 2 carries its posterior along, and calibrates the population of the contact
stiffness from 15 crest factors, N(1.73, 0.14), through a surrogate. Then 20 fresh crest factors
with an unbalance of 0.95 g judge the model. ALL DATA ARE SYNTHETIC, drawn from the distributions
that Oh et al. (2019) state for their rotor kit; the model is that of rotor.py, not theirs.

Run: uv run python examples/rotor/two_step.py [--out FOLDER]
"""

import argparse
import logging
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pymc as pm
from rotor import crest_factor, first_frequency
from scipy.stats import gaussian_kde, norm

import prbayes as prb

FREQUENCY = (45.69, 0.19)  # stated mean and standard deviation
CREST = (1.73, 0.14)  # likewise
INITIAL = {
    "k": (266.0, 26.6),
    "c": (10.55, 1.055),
    "contact": (1.0, 0.1),
}  # kN/m, N s/m, MN/m; as the paper, CoV 10%
METRICS = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "log-likelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
}
COLORS = dict(zip(METRICS, ["#0072B2", "#009E73", "#D55E00", "#CC79A7"], strict=True))
RANGES = {
    "k": (205, 325),
    "c": (3, 26),
    "contact": (0, 1.8),
}  # of the surrogates: kN/m, N s/m, MN/m
BEARINGS = {"k": (160, 380), "c": (2, 26)}


def cheap(metric):
    """A surrogate costs nothing: every theta gets its responses; more for narrow kernels."""
    n = 4608 if isinstance(metric, prb.LogLikelihood) else 256
    # Wide populations of the first step leave the ranges of the surrogate.
    return prb.Resimulated(n, max_lost=0.2)


def crest_factor_heavy(k, c, contact):
    """Crest factor with an unbalance of 0.95 g."""
    return crest_factor(k, c, contact, unbalance=0.95)


def synthetic_tests(mean, sd, n, seed):
    """Draw n normal numbers, shifted and scaled to the moments of the paper's own sample."""
    z = np.random.default_rng(seed).normal(size=n)
    return mean + sd * (z - z.mean()) / z.std(ddof=1)


def stated_values(mean, sd, n=201):
    """Return n quantiles of the stated distribution, with its moments: data without noise."""
    z = norm.ppf((np.arange(n) + 0.5) / n)
    return mean + sd * z / z.std()


def bearings(metric, observed, surrogate):
    """Step 1: the model, and its inputs. Stored responses are quicker where so many are needed."""
    narrow = isinstance(metric, prb.LogLikelihood)
    propagation = prb.Reweighted(64) if narrow else cheap(metric)
    with pm.Model() as model:
        mu_k = pm.Normal("mu_k", 266, 40)  # kN/m
        sd_k = pm.HalfNormal("sd_k", 30)
        # N s/m; the coefficient of variation is 10%, whatever the mean, so that quantiles are
        # computed once.
        mu_c = pm.Uniform("mu_c", 5, 16)
        k = pm.Gamma.dist(mu=mu_k, sigma=sd_k)
        c = pm.Gamma.dist(alpha=100, beta=100 / mu_c)
        prb.Simulator(
            "frequency",
            surrogate,
            k,
            c,
            metric=metric,
            observed=observed,
            propagation=propagation,
        )
    return model, (k, c)


def rub(metric, observed, surrogate, first, knowledge):
    """Step 2: model and inputs, with step 1 known as means, as a population, or a posterior."""
    draws = first.posterior.to_dataset().stack(sample=("chain", "draw"))
    k0, s0, c0 = (float(draws[name].mean()) for name in ("mu_k", "sd_k", "mu_c"))
    with pm.Model() as model:
        mu_r = pm.Normal("mu_r", 0.5, 0.3)  # MN/m
        sd_r = pm.HalfNormal("sd_r", 0.3)
        contact = pm.TruncatedNormal.dist(mu_r, sd_r, lower=0)
        if knowledge == "means":
            k = k0
            c = c0
        elif knowledge == "population":
            k = pm.Gamma.dist(mu=k0, sigma=s0)
            c = pm.Gamma.dist(alpha=100, beta=100 / c0)
        else:
            # The recipe: a normal distribution, in unconstrained space, of the draws of step 1 is
            # the prior of step 2.
            free = np.array([draws.mu_k, np.log(draws.sd_k), np.log(draws.mu_c)])
            carried = pm.MvNormal("carried", free.mean(axis=1), np.cov(free))
            mu_c = pm.math.exp(carried[2])
            k = pm.Gamma.dist(mu=carried[0], sigma=pm.math.exp(carried[1]))
            c = pm.Gamma.dist(alpha=100, beta=100 / mu_c)
        prb.Simulator(
            "crest",
            surrogate,
            k,
            c,
            contact,
            metric=metric,
            observed=observed,
            propagation=cheap(metric),
        )
    return model, (k, c, contact)


def sampled(model, metric, epsilon):
    """Return the posterior; the optimum includes the prior, which identifies the damping.

    The posterior given the area metric's estimate needs stored responses: draws are those of ABC.
    Draws of the log-likelihood with epsilon = 1/N are the posterior.
    """
    prb.set_epsilon(model, epsilon)
    settings = {"chains": 2, "model": model, "random_seed": 1, "progressbar": False}
    if isinstance(metric, prb.AreaMetric | prb.LogLikelihood):
        return prb.sample_smc(500, adjustment=None, **settings)
    center = prb.minimize(model, prior=True, progressbar=False)
    return prb.sample(500, optimum=center, **settings)


def carried_through(metric, observed, surrogate, first):
    """Return the optimum with step 1 as a population, and the posterior with it as prior."""
    model, inputs = rub(metric, observed, surrogate, first, "population")
    optimum = prb.minimize(model, progressbar=False)
    whole, whole_inputs = rub(metric, observed, surrogate, first, "posterior")
    # Numbers alone, without the model that they belong to: the other model takes them on purpose.
    epsilon = dict(prb.calibrate_epsilon(optimum))
    posterior = sampled(whole, metric, epsilon)
    return (model, inputs, optimum), (whole, whole_inputs, posterior)


def moments(optimum, response, inputs):
    """Return mean and standard deviation of the calibrated response."""
    values = prb.predict(optimum, response, *inputs, n_samples=8192, random_seed=0).values
    return np.nanmean(values), np.nanstd(values)


def fit_to_stated(metric):
    """Calibrate one input a response against the stated distributions; return the moments."""
    with pm.Model() as model:
        k = pm.Gamma.dist(mu=pm.Normal("mu", 266, 40), sigma=pm.HalfNormal("sd", 30))
        prb.Simulator(
            "f", first_frequency, k, 10.55, metric=metric, observed=stated_values(*FREQUENCY)
        )
    frequency = moments(prb.minimize(model, progressbar=False), first_frequency, (k, 10.55))
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.5, 0.3)
        sd = pm.HalfNormal("sd", 0.3)
        contact = pm.TruncatedNormal.dist(mu, sd, lower=0)
        prb.Simulator(
            "r", crest_factor, 266.0, 10.55, contact, metric=metric, observed=stated_values(*CREST)
        )
    optimum = prb.minimize(model, progressbar=False)
    return frequency, moments(optimum, crest_factor, (266.0, 10.55, contact)), optimum.point


def table(title, stated, fits, calibrated):
    """Print mean and standard deviation of a response with errors, as the paper's table 3."""
    mean, sd = stated
    print(f"\n{title}: stated N({mean}, {sd}); 15 tests alone leave a standard error of "
          f"{100 * sd / np.sqrt(15) / mean:.2f}% in the mean "
          f"and {100 / np.sqrt(28):.0f}% in the sd")  # fmt: skip
    print(f"{'':16s}fit to the stated distribution        fit to 15 tests\n"
          f"{'':16s}mean      error  sd      error         "
          "mean      error  sd      error")  # fmt: skip
    for label in METRICS:
        cells = [f"{m:8.4f} {100 * (m / mean - 1):+6.3f}%  {s:6.4f} {100 * (s / sd - 1):+6.2f}%"
                 for m, s in (fits[label], calibrated[label])]  # fmt: skip
        print(f"  {label:14s}{'     '.join(cells)}")


def verify(title, optimum, response, surrogate, inputs):
    """Compute the response itself for 512 specimens of the calibrated population, and compare."""
    direct, through = (
        prb.predict(optimum, f, *inputs, n_samples=512, random_seed=3).values.ravel()
        for f in (response, surrogate)
    )  # of the same specimens
    both = np.isfinite(through)
    off = through[both] - direct[both]
    print(f"  {title}: mean {direct[both].mean():.4f} directly, "
          f"{through[both].mean():.4f} through the surrogate; "
          f"sd {direct[both].std():.4f} and {through[both].std():.4f}")  # fmt: skip
    print(f"    difference: rms {np.sqrt(np.mean(off**2)):.1e}, largest {np.abs(off).max():.1e}; "
          f"{(~both).sum()} of 512 specimens outside the surrogate's ranges")  # fmt: skip


def spread(values, q):
    """Return mean and sd, over posterior draws, of a quantile of a predicted population."""
    found = values.quantile(q, "sample", skipna=True)
    return float(found.mean()), float(found.std())


def density(axis, grid, values, color, label, *, band=True):
    """Draw the density of a predicted population, with an 89% band over posterior draws."""
    flat = values.stack(population=("chain", "draw")).transpose("population", "sample").values
    curves = [gaussian_kde(v[np.isfinite(v)])(grid) for v in flat[:: max(1, len(flat) // 100)]]
    if band and len(curves) > 1:
        low, high = np.quantile(curves, [0.055, 0.945], axis=0)
        axis.fill_between(grid, low, high, color=color, alpha=0.25, lw=0)
    axis.plot(grid, np.mean(curves, axis=0), color=color, label=label)


def picture_calibration(path, observed, stated, before, after, best, label):
    """Save a response before and after calibration (the paper's figures 17 and 18)."""
    figure, axis = plt.subplots(figsize=(6.4, 4), layout="constrained")
    low = stated[0] - 5 * stated[1]
    high = stated[0] + 5 * stated[1]
    grid = np.linspace(low, high, 300)
    axis.hist(
        observed, bins=7, density=True, color="0.85", label=f"{observed.size} tests (synthetic)"
    )
    axis.plot(grid, norm.pdf(grid, *stated), "k--", lw=1, label="stated distribution")
    axis.plot(grid, gaussian_kde(before)(grid), color="0.45", label="before calibration")
    density(axis, grid, after, COLORS["PR"], "PR posterior, 89% band")
    axis.plot(grid, gaussian_kde(best)(grid), color=COLORS["area"], ls="-.", label="PR optimum")
    axis.set(xlabel=label, ylabel="density", xlim=(low, high))
    axis.legend(frameon=False, fontsize=9)
    figure.savefig(path, dpi=150)


def picture_validity(path, fresh, predicted, test, exact):
    """Save the validity check (the paper's figure 19): responses, u-values, critical values."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    grid = np.linspace(1.35, 2.25, 300)
    left.hist(
        fresh, bins=8, density=True, color="0.85", label=f"{fresh.size} fresh values (synthetic)"
    )
    density(left, grid, predicted, COLORS["PR"], "predicted, 89% band")
    left.set(xlabel="crest factor at 0.95 g", ylabel="density", title="(a) responses")
    left.set_ylim(0, 1.3 * left.get_ylim()[1])  # room for the legend above the bars
    left.legend(frameon=False, fontsize=9)
    u = np.sort(test.u_values)
    x = np.repeat(np.r_[0, u, 1], 2)[1:-1]
    y = np.repeat(np.arange(u.size + 1) / u.size, 2)
    fine = np.linspace(0, 1, 2001)
    steps = np.searchsorted(u, fine, side="right") / u.size
    middle.fill_between(
        fine, fine, steps, color=COLORS["PR"], alpha=0.25, lw=0, label=f"area {test.statistic:.3f}"
    )
    middle.plot([0, 1], [0, 1], "k--", lw=1, label="ideal")
    middle.plot(x, y, color=COLORS["area"], label="fresh values")
    middle.set(xlabel="u-value", ylabel="share of values", title="(b) u-values")
    middle.legend(frameon=False, fontsize=9)
    uniforms = np.sort(np.random.default_rng(0).random((4000, u.size)))
    under = [np.abs(np.searchsorted(row, fine) / u.size - fine).mean() for row in uniforms]
    right.hist(
        under, bins=50, density=True, color="0.85", label="areas if the model were known exactly"
    )
    for value, color, ls, label in (
        (test.statistic, COLORS["area"], "-", f"area {test.statistic:.3f}"),
        (0.1051, "0.4", ":", "0.1051, the paper's"),
        (exact.critical_value, "k", "--", f"{exact.critical_value:.4f}, exact model known"),
        (
            test.critical_value,
            COLORS["PR"],
            "--",
            f"{test.critical_value:.3f}, calibrated on 15 tests",
        ),
    ):
        right.axvline(value, 0, 0.62, color=color, ls=ls, label=label)
    right.set(
        xlabel="area metric", ylabel="density", title="(c) critical values, level 5%", ylim=(0, 32)
    )
    right.legend(frameon=False, fontsize=9)
    figure.savefig(path, dpi=150)


def picture_parameters(path, steps):
    """Save optimum and posterior of each hyperparameter by metric."""
    labels = {
        "mu_k": "mean bearing stiffness, kN/m", "sd_k": "sd of bearing stiffness, kN/m",
        "mu_c": "mean bearing damping, N s/m", "mu_r": "contact stiffness, mu, MN/m",
        "sd_r": "contact, sigma, MN/m",
    }  # fmt: skip
    figure, axes = plt.subplots(1, 5, figsize=(15, 2.8), layout="constrained", sharey=True)
    for axis, (name, label) in zip(axes, labels.items(), strict=True):
        for row, metric in enumerate(METRICS):
            optimum, posterior = steps[metric][0 if name in ("mu_k", "sd_k", "mu_c") else 1]
            low, high = posterior.posterior[name].quantile([0.055, 0.945])
            axis.plot(
                [low, high],
                [row, row],
                color=COLORS[metric],
                lw=3,
                alpha=0.5,
                solid_capstyle="butt",
            )
            axis.plot(
                posterior.posterior[name].mean(), row, "|", color=COLORS[metric], ms=14, mew=2
            )
            axis.plot(optimum.point[name], row, "o", color=COLORS[metric], mec="white", ms=8)
        axis.set(
            xlabel=label, yticks=range(len(METRICS)), yticklabels=list(METRICS), ylim=(3.5, -0.5)
        )
    axes[2].set_title("not identified: its posterior is its prior", fontsize=9)
    axes[0].set_title("optimum (dot); posterior mean, 89% interval (bar)", fontsize=9)
    figure.savefig(path, dpi=150)


def main():
    """Run both steps and the validity check, print tables, save figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for the figures")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    logging.getLogger("prbayes").setLevel(
        logging.ERROR
    )  # what is said in the log is printed below, once
    clock = time.perf_counter()
    print(
        "All data are synthetic, from the distributions stated in doi:10.1007/s00158-019-02288-6."
    )
    frequencies = synthetic_tests(*FREQUENCY, 15, seed=2019)
    crests = synthetic_tests(*CREST, 15, seed=2020)

    print("\nSTEP 1: bearing stiffness and damping from 15 first natural frequencies")
    frequency = prb.Surrogate.fit(first_frequency, BEARINGS, 64, model=prb.surrogate.Polynomial(5))
    print(
        f"surrogate: {frequency.n_runs} model runs; cross-validated error {frequency.error}, in Hz"
    )
    steps = {}
    frequency_moments = {}
    first_inputs = {}
    for label, metric in METRICS.items():
        model, inputs = bearings(metric, frequencies, frequency)
        optimum = prb.minimize(model, progressbar=False)
        posterior = sampled(model, metric, prb.calibrate_epsilon(optimum))
        steps[label], first_inputs[label] = [(optimum, posterior)], inputs
        frequency_moments[label] = moments(optimum, frequency, inputs)
        print(f"\n{label}")
        shown = prb.compare({"optimum": optimum, "posterior": posterior}, model=model)
        print(shown[["estimate", "sd", "lower", "upper"]].to_dataframe().round(2).to_string())
        for finding in optimum.findings:
            print(f"  reported by prb.minimize: {finding}")

    print(
        "\nSTEP 2: contact stiffness from 15 crest factors, through a surrogate "
        f"({time.perf_counter() - clock:.0f} s)"
    )
    surrogate = prb.Surrogate.fit(crest_factor, RANGES, 128, model=prb.surrogate.Polynomial(4))
    print(f"surrogate: {surrogate.n_runs} model runs; cross-validated error {surrogate.error}")
    wide = prb.Surrogate.fit(
        crest_factor, RANGES | {"contact": (0, 2.5)}, 128, model=prb.surrogate.Polynomial(4)
    )
    print(f"had its ranges gone up to 2.5 MN/m, where the vibration jumps: {wide.error}")
    crest_moments = {}
    known = {}
    whole = {}
    for label, metric in METRICS.items():
        known[label], whole[label] = carried_through(metric, crests, surrogate, steps[label][0][1])
        model, inputs, optimum = known[label]
        whole_model, _, posterior = whole[label]
        steps[label].append((optimum, posterior))
        crest_moments[label] = moments(optimum, surrogate, inputs)
        print(f"\n{label}")
        # Two models, so a table for each, of the hyperparameters that both have.
        tables = []
        for name, result, of in (
            ("optimum", optimum, model),
            ("posterior, step 1 carried", posterior, whole_model),
        ):
            shown = prb.compare({name: result}, model=of)[["estimate", "sd", "lower", "upper"]]
            tables.append(shown.sel(hyperparameter=["mu_r", "sd_r"]).to_dataframe())
        print(pd.concat(tables).round(3).to_string())

    print(f"\nWHAT IGNORING STEP 1'S UNCERTAINTY COSTS (PR; {time.perf_counter() - clock:.0f} s)")
    print("step 1 known as  contact mu       sigma            95% of crest     5% of frequency, Hz")
    first = steps["PR"][0][1]
    for knowledge in ("means", "population", "posterior"):
        if knowledge == "posterior":
            model, inputs, posterior = whole["PR"]
        else:
            model, inputs = rub(METRICS["PR"], crests, surrogate, first, knowledge)
            posterior = sampled(
                model, METRICS["PR"], prb.calibrate_epsilon(prb.minimize(model, progressbar=False))
            )
        crest = prb.predict(posterior, surrogate, *inputs, model=model, random_seed=2)
        cells = [
            (float(posterior.posterior[n].mean()), float(posterior.posterior[n].std()))
            for n in ("mu_r", "sd_r")
        ]
        cells.append(spread(crest, 0.95))
        if knowledge == "means":
            cells.append((float(first_frequency(*inputs[:2])), 0.0))
        elif knowledge == "population":
            k0, s0 = (float(first.posterior[n].mean()) for n in ("mu_k", "sd_k"))
            k = np.random.default_rng(0).gamma((k0 / s0) ** 2, s0**2 / k0, 4000)
            cells.append((float(np.quantile(first_frequency(k, 10.0), 0.05)), 0.0))
        else:
            predicted = prb.predict(posterior, frequency, *inputs[:2], model=model, random_seed=2)
            cells.append(spread(predicted, 0.05))
        print(f"  {knowledge:14s} " + " ".join(f"{m:7.3f} ± {s:5.3f} " for m, s in cells))

    print(f"\nTABLE 3 ({time.perf_counter() - clock:.0f} s)")
    fits = {label: fit_to_stated(metric) for label, metric in METRICS.items()}
    table(
        "first natural frequency, Hz",
        FREQUENCY,
        {m: f[0] for m, f in fits.items()},
        frequency_moments,
    )
    table("crest factor", CREST, {m: f[1] for m, f in fits.items()}, crest_moments)
    share = norm.cdf((np.sqrt(2) - CREST[0]) / CREST[1])
    print(
        "This rub gives no crest factor below sqrt(2), that of a sine; "
        f"{share:.1%} of the stated normal is there."
    )

    print(f"\nDIRECT MODEL RUNS AT THE PR OPTIMUM ({time.perf_counter() - clock:.0f} s)")
    verify(
        "first natural frequency, Hz",
        steps["PR"][0][0],
        first_frequency,
        frequency,
        first_inputs["PR"],
    )
    verify("crest factor", known["PR"][2], crest_factor, surrogate, known["PR"][1])

    print("\nVALIDITY: 20 fresh crest factors with an unbalance of 0.95 g")
    # Synthetic: the population that fits the stated distribution, at the new unbalance, through the
    # model itself.
    truth = fits["PR"][2]
    rng = np.random.default_rng(95)
    drawn = rng.normal(truth["mu"], truth["sd"], 100)
    fresh = crest_factor_heavy(
        rng.normal(266, 15.5, 20), rng.normal(10.55, 1.055, 20), drawn[drawn > 0][:20]
    )
    heavy = prb.Surrogate.fit(crest_factor_heavy, RANGES, 128, model=prb.surrogate.Polynomial(4))
    print(f"  surrogate at 0.95 g: {heavy.n_runs} model runs; cross-validated error {heavy.error}")
    model, inputs, posterior = whole["PR"]
    predicted = prb.predict(
        posterior, heavy.with_error(), *inputs, model=model, name="heavy", random_seed=4
    )
    exact = prb.area_test(fresh, predicted, null=prb.validation.ExactModel())
    test = prb.area_test(fresh, predicted)
    print(
        f"  known exactly, critical value {exact.critical_value:.4f} "
        f"(the paper's 0.1051 is too small):\n{exact}"
    )
    print(f"  calibrated on 15 tests:\n{test}")
    uniforms = np.random.default_rng(0).random((400, 20))
    areas = [
        prb.area_test(u, np.linspace(0, 1, 2001), null=prb.validation.ExactModel()).statistic
        for u in uniforms
    ]
    print(
        "  a critical value of 0.1051 rejects an exact model in "
        f"{np.mean(np.array(areas) > 0.1051):.0%} of 400 cases"
    )
    wrong = prb.area_test(fresh + 0.12, predicted)
    print(f"  the same values, 0.12 higher (a model that is wrong): area {wrong.statistic:.3f}, "
          f"{'rejected' if wrong.rejected else 'not rejected'}")  # fmt: skip

    rng = np.random.default_rng(1)
    before = {name: rng.normal(*INITIAL[name], 2000) for name in INITIAL}
    model = steps["PR"][0][0].model
    after = prb.predict(first, frequency, *first_inputs["PR"], model=model, random_seed=5)
    best = prb.predict(
        steps["PR"][0][0], frequency, *first_inputs["PR"], random_seed=5
    ).values.ravel()
    start = first_frequency(before["k"], before["c"])
    picture_calibration(
        out / "rotor_frequency.png", frequencies, FREQUENCY, start,
        after, best, "first natural frequency, Hz",
    )  # fmt: skip
    model, inputs, posterior = whole["PR"]
    after = prb.predict(posterior, surrogate, *inputs, model=model, random_seed=5)
    best = prb.predict(known["PR"][2], surrogate, *known["PR"][1], random_seed=5).values.ravel()
    start = crest_factor(**{name: values[:500] for name, values in before.items()})
    picture_calibration(
        out / "rotor_crest.png", crests, CREST, start,
        after, best[np.isfinite(best)], "crest factor",
    )  # fmt: skip
    picture_validity(out / "rotor_validity.png", fresh, predicted, test, exact)
    picture_parameters(out / "rotor_parameters.png", steps)
    print(f"\nfigures: {out / 'rotor_*.png'}; {time.perf_counter() - clock:.0f} s")


if __name__ == "__main__":
    main()
