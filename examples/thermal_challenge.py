"""Does a device get too hot? The thermal challenge problem of Sandia, from coupons to a verdict.

Conductivity and heat capacity of 30 coupons calibrate a population of slabs. It predicts four slabs
that were heated (ensemble), and one that was heated more (accreditation), both of which are tested;
then the probability that the heated face of the device is above 900 C after 1000 s, which is
required to be below 0.01; what that hangs on; and which test would tell most.

Run: uv run python examples/thermal_challenge.py [--out FOLDER]
"""

import argparse
import csv
import time
from pathlib import Path

import numpy as np
import pymc as pm

import prbayes as prb

DATA = Path(__file__).with_name("thermal")
START = 25.0  # C: of a slab
TEMPERATURES = [20.0, 250.0, 500.0, 750.0, 1000.0]  # C: of the coupons
LIMIT = 900.0  # C
ALLOWED = 0.01  # share of specimens that may exceed it
TERMS = 40  # of the series: what is left out is below 0.1 C from 10 s on

# A slab's conductivity is that at 20 C, and what it gains until 1000 C.
RISE = prb.response.Additive(TEMPERATURES)


# -- heat conduction -------------------------------------------------------------------------------


def series(conductivity, capacity, flux, thickness, seconds, place=0.0):
    """Temperature in C of a slab with constant properties, heated on one face, insulated behind.

    The published equation (Dowding, Pilch, Hills 2008). Arrays broadcast against each other:
    W/(m C), J/(m^3 C), W/m^2, m, s, and the place as a share of the thickness.
    """
    fourier = conductivity / capacity * seconds / thickness**2
    total = fourier + 1 / 3 - place + place**2 / 2
    for n in range(1, TERMS + 1):
        wave = (n * np.pi) ** 2
        total = total - 2 / wave * np.exp(-wave * fourier) * np.cos(n * np.pi * place)
    return START + flux * thickness / conductivity * total


def slab(conductivity, rise, capacity, flux, thickness, seconds, place=0.0):
    """The same with the conductivity at the slab's mean temperature, which the heat input tells."""
    mean = START + flux * seconds / (capacity * thickness)
    return series(conductivity + RISE.value(rise, mean), capacity, flux, thickness, seconds, place)


def differences(conductivity, rise, capacity, flux, thickness, seconds, cells=40, steps=200):
    """Temperature in C of the heated face by finite volumes, with conductivity that follows it.

    Backward Euler; the conductivity is that of the step's own end, found by repetition.
    """
    conductivity, rise, capacity = np.broadcast_arrays(conductivity, rise, capacity)
    width = thickness / cells
    step = seconds / steps
    volumes = np.full((cells + 1, 1), width)
    volumes[[0, -1]] /= 2
    shape = conductivity.shape
    conductivity, rise, capacity = (x.reshape(1, -1) for x in (conductivity, rise, capacity))
    stored = capacity * volumes / step
    now = np.full((cells + 1, conductivity.size), START)
    for _ in range(steps):
        after = now
        for _ in range(3):
            at_nodes = conductivity + RISE.value(rise, after)
            between = (at_nodes[1:] + at_nodes[:-1]) / 2 / width
            right = stored * now
            right[0] += flux
            after = tridiagonal(stored, between, right)
        now = after
    return now[0].reshape(shape)


def tridiagonal(stored, between, right):
    """Solve the equations of a step by elimination, cell by cell; columns are slabs."""
    diagonal = stored.copy() + np.zeros_like(right)
    diagonal[:-1] += between
    diagonal[1:] += between
    right = right.copy()
    last = len(right) - 1
    for i in range(last):
        factor = between[i] / diagonal[i]
        diagonal[i + 1] -= factor * between[i]
        right[i + 1] += factor * right[i]
    found = np.empty_like(right)
    found[last] = right[last] / diagonal[last]
    for i in reversed(range(last)):
        found[i] = (right[i] + between[i] * found[i + 1]) / diagonal[i]
    return found


def device(conductivity, rise, capacity):
    """Temperature of the device's heated face after 1000 s."""
    return slab(conductivity, rise, capacity, 3500.0, 0.019, 1000.0)


def device_by_differences(conductivity, rise, capacity):
    """The same by finite differences."""
    return differences(conductivity, rise, capacity, 3500.0, 0.019, 1000.0)


# -- data ------------------------------------------------------------------------------------------


def table(name):
    """Return the columns of a file of data."""
    with (DATA / f"{name}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {column: np.array([row[column] for row in rows]) for column in rows[0]}


def heat_capacities(only):
    """Return heat capacities of the coupons in a set, "n20" or "n30"."""
    coupons = table("material")
    chosen = [only in sets for sets in coupons["in_set"]]
    return coupons["rhoCp_J_per_m3C"].astype(float)[chosen]


def coupons():
    """Return conductivities by temperature and heat capacities, (60, 6), and labels of coupons.

    Each row is one measurement: populations of conductivity and capacity are independent.
    """
    material = table("material")
    temperatures = material["temperature_C"].astype(float)
    n = len(temperatures)
    measured = np.full((2 * n, len(TEMPERATURES) + 1), np.nan)
    column = [TEMPERATURES.index(temperature) for temperature in temperatures]
    measured[np.arange(n), column] = material["k_W_per_mC"].astype(float)
    measured[n:, -1] = material["rhoCp_J_per_m3C"].astype(float)
    return measured, np.tile(np.arange(n), 2)


# -- the study -------------------------------------------------------------------------------------


def capacity_alone(observed, metric):
    """Calibrate the population of heat capacities alone; return the optimum."""
    with pm.Model() as model:
        mean = pm.Normal("mean", 4e5, 1e5)
        capacity = pm.Normal.dist(mean, pm.HalfNormal("sd", 1e5))
        prb.Simulator("capacity", lambda c: c, capacity, metric=metric, observed=observed)
    return prb.minimize(model, progressbar=False)


def at_20(conductivity, capacity):
    """What is measured on coupons: conductivity at each temperature, as if it were constant."""
    same = [conductivity] * len(TEMPERATURES)
    return np.stack([*same, capacity], axis=-1)


def population():
    """Return the model, and its inputs: conductivity at 20 C, rise, heat capacity."""
    observed, labels = coupons()
    with pm.Model() as model:
        mean = pm.Normal("mean k", 0.05, 0.005)
        sd = pm.HalfNormal("sd k", 0.005)
        conductivity = pm.Normal.dist(mean, sd, name="conductivity at 20 C")
        mean = pm.Normal("mean rise", 0.02, 0.01)
        sd = pm.HalfNormal("sd rise", 0.005)
        rise = pm.Normal.dist(mean, sd, name="rise")
        mean = pm.Normal("mean rhoCp", 4e5, 4e4)
        sd = pm.HalfNormal("sd rhoCp", 6e4)
        capacity = pm.Normal.dist(mean, sd, name="heat capacity")
        # The sixth output, the heat capacity, has no inadequacy.
        prb.Simulator(
            "coupon",
            RISE.of(at_20, [*TEMPERATURES, np.nan]),
            *(conductivity, capacity, rise),
            metric=prb.Joint(prb.KullbackLeibler()),
            observed=observed,
            specimens=labels,
            propagation=prb.Reweighted(64),
        )
    return model, (conductivity, rise, capacity)


def ensemble(posterior, model, inputs):
    """Return seconds, temperatures of four slabs (4, times), and predictions of them."""
    measured = table("ensemble")
    seconds = measured["time_s"].astype(float)[1:]
    slabs = np.array([measured[f"exp{i}"].astype(float)[1:] for i in range(1, 5)])

    def heated(conductivity, rise, capacity):
        properties = (x[..., None] for x in (conductivity, rise, capacity))
        return slab(*properties, 1000.0, 0.0254, seconds)

    predicted = prb.predict(posterior, heated, *inputs, model=model, random_seed=1)
    return seconds, slabs, predicted


def accreditation(posterior, model, inputs):
    """Return seconds, temperatures of one slab by place and time, and predictions of them.

    From 500 s on: before, the back is as cold as in the beginning.
    """
    measured = table("accreditation")
    seconds = measured["time_s"].astype(float)
    late = seconds >= 500
    places = {"x=0": 0.0, "x=L/2": 0.5, "x=L": 1.0}
    observed = {name: measured[name].astype(float)[late] for name in places}
    predicted = {}
    for name, place in places.items():

        def heated(conductivity, rise, capacity, place=place):
            properties = (x[..., None] for x in (conductivity, rise, capacity))
            return slab(*properties, 3000.0, 0.019, seconds[late], place)

        predicted[name] = prb.predict(posterior, heated, *inputs, model=model, random_seed=1)
    return seconds[late], observed, predicted


def tested(seconds, observed, predicted, slabs):
    """Test means and spreads of conditions together, by the labels of their slabs.

    Places have temperatures (slabs, times), and predictions with times last.
    """
    measured = {}
    populations = {}
    for place, values in observed.items():
        for i, second in enumerate(seconds):
            condition = f"{place}, {second:.0f} s"
            measured[condition] = values[:, i]
            populations[condition] = predicted[place][..., i]
    labels = dict.fromkeys(measured, slabs)
    return {
        what: prb.area_test(
            measured, populations, specimens=labels, folded=folded, progressbar=False
        )
        for what, folded in {"means": False, "spreads": True}.items()
    }


def coupons_at(temperature):
    """Return what coupons at a temperature would show: conductivity and heat capacity."""

    def coupon(conductivity, rise, capacity):
        return np.stack([conductivity + RISE.value(rise, temperature), capacity], axis=-1)

    return coupon


def candidates(inputs):
    """Return the tests among which one is chosen."""
    both = prb.Joint(prb.KullbackLeibler())
    found = {
        f"coupons at {t:.0f} C": prb.decision.Condition(coupons_at(t), *inputs, metric=both)
        for t in (20.0, 500.0, 1000.0)
    }
    one = prb.KullbackLeibler()
    return found | {"devices at 3500 W/m2": prb.decision.Condition(device, *inputs, metric=one)}


def study():
    """Return all figures of the study, and what the picture needs."""
    found = {"capacity": {}}
    for metric in (
        prb.KullbackLeibler(),
        prb.LogLikelihood(density=prb.GaussianKDE()),
        prb.ProbabilityResidual(),
        prb.AreaMetric(),
    ):
        alone = capacity_alone(heat_capacities("n20"), metric)
        row = {"sd": float(alone.point["sd"]), "error": float(alone.stderr["sd"])}
        found["capacity"][type(metric).__name__] = row
    found["sample sd"] = float(heat_capacities("n20").std(ddof=1))

    model, inputs = population()
    optimum = prb.minimize(model, progressbar=False)
    posterior = prb.sample(
        500, chains=2, model=model, optimum=optimum, random_seed=1, progressbar=False
    )
    found["runs"] = optimum.n_responses
    found["warnings"] = list(map(str, optimum.findings))
    found["population"] = {
        name: {
            "optimum": float(optimum.point[name]),
            "error": float(optimum.stderr[name]),
            "mean": float(posterior.posterior[name].mean()),
            "sd": float(posterior.posterior[name].std()),
        }
        for name in optimum.point
    }

    # Slabs that were not calibrated on.
    seconds, slabs, predicted = ensemble(posterior, model, inputs)
    names = [f"slab {i + 1}" for i in range(len(slabs))]
    tests = tested(seconds, {"x=0": slabs}, {"x=0": predicted}, names)
    found["ensemble"] = told(slabs[:, -1], predicted[..., -1], tests)
    late, observed, at_places = accreditation(posterior, model, inputs)
    one = {place: values[None] for place, values in observed.items()}
    tests = tested(late, one, at_places, ["slab"])
    last = {
        place: told(values[-1:], at_places[place][..., -1]) for place, values in observed.items()
    }
    found["accreditation"] = told(observed["x=0"][-1:], at_places["x=0"][..., -1], tests)
    found["accreditation"]["places"] = last

    # The requirement, by the published equation and with conductivity that follows temperature.
    found["risk"] = {}
    for response in (device, device_by_differences):
        for points in (0, 1000):
            risk = prb.exceedance(
                posterior,
                response,
                LIMIT,
                *inputs,
                model=model,
                requirement=ALLOWED,
                n_points=points,
                random_seed=1,
            )
            row = {name: float(risk[name]) for name in ("probability", "lower", "upper", "error")}
            row["above"] = float((risk.by_draw > ALLOWED).mean())
            row["verdict"] = risk.attrs["verdict"]
            found["risk"][f"{response.__name__}/{points}"] = row

    # What it hangs on, and what to test next.
    quantity = prb.decision.Exceedance(device, *inputs, limit=LIMIT)
    shares = prb.sensitivity(posterior, quantity, model=model)
    columns = shares[["first", "first_error", "total", "total_error"]].to_dataframe()
    found["sensitivity"] = columns.drop(columns="kind", errors="ignore").to_dict("index")
    spread = shares.attrs["sd"]
    plan = prb.plan(
        posterior,
        candidates(inputs),
        k=[10, 50],
        model=model,
        quantity=quantity,
        max_sd={"quantity": spread / 2},
    )
    found["plan"] = {"now": float(plan.now.sel(name="quantity")), "tests": {}}
    for name in plan.candidate.values:
        row = plan.sel(candidate=name, name="quantity")
        found["plan"]["tests"][str(name)] = {
            "after 10": float(row.sd.sel(k=10)),
            "after 50": float(row.sd.sel(k=50)),
            "halves": float(row.specimens),
        }
    values = prb.predict(posterior, device, *inputs, model=model, random_seed=1)
    return found, (posterior, seconds, slabs, predicted, values)


def told(measured, predicted, tests=None):
    """Return mean and spread of measured and predicted temperatures, and p-values of tests."""
    row = {
        "measured": float(measured.mean()),
        "predicted": float(predicted.mean()),
        "predicted sd": float(predicted.std()),
    }
    if measured.size > 1:
        row["measured sd"] = float(measured.std(ddof=1))
    for what, test in (tests or {}).items():
        row[f"p, {what}"] = float(test.p_value)
    return row


# -- told ------------------------------------------------------------------------------------------


def report(found):
    """Print what was found."""
    print(f"heat capacity of 20 coupons: sample sd {found['sample sd']:.0f} J/(m3 C)")
    for name, row in found["capacity"].items():
        share = row["sd"] / found["sample sd"] - 1
        print(f"  {name:20} sd {row['sd']:6.0f} +- {row['error']:4.0f} ({share:+.1%})")
    print(f"\npopulation of 30 coupons, {found['runs']} runs: optimum, posterior")
    for name, row in found["population"].items():
        optimum = f"{row['optimum']:.4g} +- {row['error']:.2g}"
        print(f"  {name:12} {optimum:>20} {row['mean']:>12.4g} +- {row['sd']:.2g}")
    print("\n".join(found["warnings"]))
    for name in ("ensemble", "accreditation"):
        row = found[name]
        print(
            f"{name}, x = 0 at 1000 s: measured {row['measured']:.0f}, predicted "
            f"{row['predicted']:.0f} +- {row['predicted sd']:.0f} C; all times and places: p "
            f"{row['p, means']:.2f} (means), {row['p, spreads']:.2f} (spreads)"
        )
    print(f"\nP(T > {LIMIT:.0f} C), required below {ALLOWED}")
    for name, row in found["risk"].items():
        print(
            f"  {name:27} {row['probability']:.3f}, 90% interval {row['lower']:.3f} to "
            f"{row['upper']:.3f}, error {row['error']:.3f}: {row['verdict']}"
        )
    print("\nshares: of hyperparameters in its uncertainty, of inputs in the scatter; first, total")
    for name, row in found["sensitivity"].items():
        print(f"  {name:21} {row['first']:5.2f} {row['total']:5.2f}")
    print(f"\nsd of the probability {found['plan']['now']:.3f}; after 10 and 50 more, halved by")
    for name, row in found["plan"]["tests"].items():
        print(
            f"  {name:21} {row['after 10']:.3f} {row['after 50']:.3f} {row['halves']:5.0f} of them"
        )


def picture(kept, path):
    """Draw coupons, the ensemble and the device."""
    from matplotlib.figure import Figure

    posterior, seconds, slabs, predicted, values = kept
    blue = "#0072B2"
    red = "#D55E00"
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)

    material = table("material")
    grid = np.linspace(20, 1000, 50)
    draws = {name: posterior.posterior[name].values.reshape(-1, 1) for name in posterior.posterior}
    z = RISE.value(1.0, grid)
    center = draws["mean k"] + draws["mean rise"] * z
    spread = np.sqrt(draws["sd k"] ** 2 + (draws["sd rise"] * z) ** 2)
    rng = np.random.default_rng(1)
    new = center + spread * rng.standard_normal(center.shape)
    left.fill_between(grid, *np.quantile(new, [0.055, 0.945], axis=0), color=blue, alpha=0.2, lw=0)
    left.plot(grid, center.mean(axis=0), color=blue)
    temperature = material["temperature_C"].astype(float)
    left.plot(temperature, material["k_W_per_mC"].astype(float), "o", color=red, ms=4)
    left.set(xlabel="temperature, °C", ylabel="conductivity, W/(m °C)", title="30 coupons")

    flat = predicted.values.reshape(-1, seconds.size)
    middle.fill_between(
        seconds, *np.quantile(flat, [0.055, 0.945], axis=0), color=blue, alpha=0.2, lw=0
    )
    middle.plot(seconds, flat.mean(axis=0), color=blue)
    middle.plot(seconds, slabs.T, "o", color=red, ms=3)
    middle.set(xlabel="time, s", ylabel="heated face, °C", title="ensemble, 1000 W/m², 2.54 cm")

    populations = np.sort(values.values.reshape(-1, values.shape[-1]), axis=1)
    level = (np.arange(populations.shape[1]) + 0.5) / populations.shape[1]
    band = np.quantile(populations, [0.05, 0.95], axis=0)
    right.fill_betweenx(1 - level, *band, color=blue, alpha=0.2, lw=0)
    right.plot(populations.mean(axis=0), 1 - level, color=blue)
    right.axvline(LIMIT, color="k", lw=1)
    right.axhline(ALLOWED, color="k", lw=1, ls=":")
    right.set(
        xlabel="T, °C",
        ylabel="share of devices above T",
        title="device, 3500 W/m², 1.90 cm",
        xlim=(650, 1100),
        ylim=(0.002, 1),
        yscale="log",
    )
    path.mkdir(parents=True, exist_ok=True)
    figure.savefig(path / "thermal_challenge.png", dpi=110)


def main(out):
    clock = time.perf_counter()
    found, kept = study()
    report(found)
    print(f"\n{time.perf_counter() - clock:.0f} s")
    if out is not None:
        picture(kept, out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path)
    main(parser.parse_args().out)
