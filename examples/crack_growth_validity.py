"""Does the calibrated population agree with specimens, and conditions, that it has not seen?

Eleven specimens calibrate the population of Paris' coefficient C from their crack lengths after 50
000 cycles, with one exponent for all; the other ten are tested at 80 000 cycles, and at 50 000 to
120 000 cycles together. Then all 21 calibrate, and are tested on themselves by the joint null;
there also how much a crack grew from 50 000 to 80 000 cycles for each inch before. The same again
with exponents that vary, correlated with C.

A specimen that has failed and was removed is no missing value: it counts above all lengths,
measured and predicted.

Run: uv run python examples/crack_growth_validity.py [--out FOLDER] [--splits N]
"""

import argparse
import time
from pathlib import Path

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from crack_growth import EXPONENT, growth
from scipy.optimize import least_squares

import prbayes as prb

DATA = prb.datasets.crack_growth()
INCH = DATA.crack_length_inch
LABELS = DATA.specimen.values
REMOVED = 1.6  # inch: a specimen that has been read so long is not tested on
CYCLES = (0.05, 0.08, 0.10, 0.12)  # million
ALL = np.arange(LABELS.size)


def length(C, m, t=0.05):
    """Crack length in inch after t million cycles."""
    return DATA.notch_inch * growth(C, m, t)


def reading(t):
    """Return what is read after t million cycles, to 0.01 inch; +inf where it was removed."""

    def read(C, m):
        removed = np.round(length(C, m, t - 0.01), 2) >= REMOVED
        return np.where(removed, np.inf, np.round(length(C, m, t), 2))

    return read


def ratio(early, late):
    """Logarithm of the growth between two readings over the growth before the first.

    Less growth than .005 inch is not seen.
    """
    with np.errstate(all="ignore"):
        grown = np.log(np.maximum(late - early, 0.005) / np.maximum(early - DATA.notch_inch, 0.005))
    return np.where(np.isfinite(late), grown, np.inf)


def ratio_of(C, m):
    """Return the ratio of a specimen."""
    return ratio(reading(0.05)(C, m), reading(0.08)(C, m))


def of_pair(response):
    """Let a response take log C and m as one vector."""
    return lambda z: response(np.exp(z[..., 0]), z[..., 1])


def measured(t, who):
    """Readings after t million cycles; +inf for specimens that had been removed."""
    values = INCH.sel(million_cycles=t).values[who]
    return np.where(np.isnan(values), np.inf, values)


def one_exponent(who):
    """Return a model of C with one exponent, its inputs, and what makes a response of them."""
    with pm.Model() as model:
        C = pm.LogNormal.dist(pm.Normal("mu", 1.1, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator(
            "crack",
            length,
            C,
            EXPONENT,
            metric=prb.AreaMetric(),
            observed=measured(0.05, who),
            specimens=LABELS[who],
        )
    return model, (C, EXPONENT), lambda response: response


def fits(who):
    """Fit log C and m to each specimen's whole record by least squares, shape (specimens, 2)."""
    cycles = DATA.million_cycles.values
    found = []
    for lengths in INCH.values[who]:
        use = np.isfinite(lengths) & (cycles > 0)

        def residuals(p, lengths=lengths, use=use):
            left = 1 - (p[1] - 1) * np.exp(p[0]) * cycles[use]
            return DATA.notch_inch * np.maximum(left, 1e-3) ** (-1 / (p[1] - 1)) - lengths[use]

        found.append(least_squares(residuals, [1.1, EXPONENT]).x)
    return np.array(found)


def random_exponent(who):
    """Return the same with exponents that vary: populations of them by least squares."""
    found = fits(who)
    mean = found[:, 1].mean()
    sd = found[:, 1].std(ddof=1)
    rho = np.corrcoef(found.T)[0, 1]
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.1, 0.5)
        sigma = pm.HalfNormal("sigma", 0.5)
        covariance = pt.stacklists([[sigma**2, rho * sigma * sd], [rho * sigma * sd, sd**2]])
        z = pm.MvNormal.dist(pt.stack([mu, mean]), covariance)
        prb.Simulator(
            "crack",
            of_pair(length),
            z,
            metric=prb.AreaMetric(),
            observed=measured(0.05, who),
            specimens=LABELS[who],
        )
    return model, (z,), of_pair


def check(result, model, inputs, wrap, who, conditions, null=None):
    """Test specimens under named conditions, (values, response) each, for mean and for spread."""
    responses = {name: wrap(response) for name, (_, response) in conditions.items()}
    observed = {name: values for name, (values, _) in conditions.items()}
    predicted = {
        n: prb.predict(result, f, *inputs, model=model, random_seed=1) for n, f in responses.items()
    }
    if null is not None:
        calls = {n: (f, *inputs) for n, f in responses.items()}
        null = null(result, responses=calls, replicates=499)
    specimens = dict.fromkeys(conditions, LABELS[who])
    return [
        prb.area_test(observed, predicted, specimens=specimens, null=null, folded=folded)
        for folded in (False, True)
    ]


def line(what, tests):
    """Print one row of the table."""
    plain, folded = tests
    print(
        f"{what:45s} {plain.statistic:6.3f} {plain.critical_value:9.3f} "
        f"{plain.p_value:7.3f} {folded.p_value:9.3f}",
        flush=True,
    )


def main():
    """Print the table of tests, save the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for the figure")
    parser.add_argument("--splits", type=int, default=1, help="random halves of the specimens")
    arguments = parser.parse_args()
    clock = time.perf_counter()
    readings = {f"{round(t * 1000)} 000 cycles": (t, reading(t)) for t in CYCLES}
    print(f"{'':45s} {'area':>6s} {'critical':>9s} {'p':>7s} {'p, spread':>9s}")
    kept = {}
    for label, build in (("one exponent", one_exponent), ("exponents vary", random_exponent)):
        for split in range(arguments.splits):
            order = np.random.default_rng(split).permutation(LABELS.size)
            calibrating = np.sort(order[:11])
            others = np.sort(order[11:])
            print(f"{label}, calibrated on specimens {' '.join(map(str, LABELS[calibrating]))}")
            model, inputs, wrap = build(calibrating)
            posterior = prb.sample_smc(
                1000, chains=2, model=model, random_seed=1, progressbar=False
            )
            values = {name: (measured(t, others), f) for name, (t, f) in readings.items()}
            late = {"80 000 cycles": values["80 000 cycles"]}
            line(
                "  the other 10 at 80 000 cycles",
                check(posterior, model, inputs, wrap, others, late),
            )
            tests = check(posterior, model, inputs, wrap, others, values)
            line("  the other 10 at 50 000 to 120 000, pooled", tests)
            kept.setdefault(f"{label}, 10 others pooled", tests[0])
        print(f"{label}, calibrated on all 21, which are tested: joint null")
        model, inputs, wrap = build(ALL)
        optimum = prb.minimize(model)
        values = {name: (measured(t, ALL), f) for name, (t, f) in readings.items()}
        late = {"80 000 cycles": values["80 000 cycles"]}
        growing = {"growth ratio": (ratio(measured(0.05, ALL), measured(0.08, ALL)), ratio_of)}
        for what, conditions in (
            ("at 80 000 cycles", late),
            ("at 50 000 to 120 000 cycles, pooled", values),
            ("growth to 80 000 over that to 50 000", growing),
        ):
            tests = check(optimum, model, inputs, wrap, ALL, conditions, prb.validation.JointNull)
            line(f"  all 21 {what}", tests)
        kept[f"{label}, growth ratio"] = tests[0]
    arguments.out.mkdir(parents=True, exist_ok=True)
    prb.plots.plot_validity(kept, col_wrap=2).savefig(arguments.out / "crack_growth_validity.png")
    print(
        f"figure: {arguments.out / 'crack_growth_validity.png'}; "
        f"{time.perf_counter() - clock:.0f} s"
    )


if __name__ == "__main__":
    main()
