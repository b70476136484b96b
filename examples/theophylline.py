"""A drug in the blood of 12 subjects: own doses, own times, and an unknown error of the readings.

The response is called as a black box. The estimates agree with published ones of the same model and
data by maximum likelihood. A second, simulated case has two kinds of subjects: fast absorption and
slow absorption.

Run: uv run python examples/theophylline.py
"""

import numpy as np
import pymc as pm

import prbayes as prb

# Maximum likelihood (log values, between-subject CV in %, error in mg/l), and standard errors.
PUBLISHED = {
    "ka": (0.458, 0.193),
    "cl": (1.012, 0.085),
    "v": (3.45, 0.047),
    "cv_ka": (70.7, None),
    "cv_cl": (27.0, None),
    "cv_v": (13.6, None),
    "error": (0.696, None),
}


def concentration(ka, cl, v, dose, time):
    """Concentration in mg/l: absorption ka in 1/h, clearance cl in l/h, volume v in l."""
    ka, cl, v, dose = (np.asarray(x)[..., None] for x in (ka, cl, v, dose))
    rise = np.exp(-cl / v * time) - np.exp(-ka * time)
    return dose * ka / (v * ka - cl) * rise


def population(drug):
    """Model of the subjects: lognormal rate of absorption, clearance and volume."""
    with pm.Model() as model:
        dose = prb.response.condition("dose", drug.dose_mg)
        time = prb.response.condition("time", drug.time_h)
        inputs = []
        for name, middle in (("ka", 0.5), ("cl", 1.0), ("v", 3.5)):
            mu = pm.Normal(name, middle, 0.5)
            sigma = pm.HalfNormal(f"sigma_{name}", 0.5)
            inputs.append(pm.LogNormal.dist(mu, sigma))
        error = pm.HalfNormal("error", 0.7)
        prb.Simulator(
            "drug", concentration, *inputs, dose, time,
            observed=drug.concentration_mg_per_l.values,
            metric=prb.LogLikelihood(error=error),
            propagation=prb.Resimulated(),  # microseconds a call: no emulator
        )  # fmt: skip
    return model


def two_kinds(n=40, seed=1):
    """Simulate subjects whose absorption is fast (3.5 / h) or slow (.7 / h), and their model."""
    rng = np.random.default_rng(seed)
    is_fast = rng.random(n) < 0.4
    log_ka = np.where(is_fast, np.log(3.5), np.log(0.7)) + rng.normal(0, 0.2, n)
    ka, ke = np.exp(log_ka), np.exp(rng.normal(np.log(0.1), 0.2, n))
    dose = rng.choice([100.0, 200.0, 300.0], n)
    times = np.array([0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0])

    def amount(log_ka, log_ke, dose):
        log_ka, log_ke, dose = (np.asarray(x)[..., None] for x in (log_ka, log_ke, dose))
        ka, ke = np.exp(log_ka), np.exp(log_ke)
        return dose * ka / (ka - ke) * (np.exp(-ke * times) - np.exp(-ka * times))

    readings = amount(np.log(ka), np.log(ke), dose) + rng.normal(0, 4.0, (n, len(times)))
    with pm.Model() as model:
        known = prb.response.condition("dose", dose)
        slow, gap = pm.Normal("slow", -0.4, 0.5), pm.HalfNormal("gap", 2.0)  # of log(ka)
        middles = pm.math.stack([slow, slow + gap])
        share = pm.Beta("fast", 2, 2)
        spread = pm.HalfNormal("spread", 0.5)
        weights = pm.math.stack([1 - share, share])
        absorption = pm.NormalMixture.dist(weights, middles, spread)
        elimination = pm.Normal.dist(
            pm.Normal("log_ke", np.log(0.1), 0.3), pm.HalfNormal("sigma_ke", 0.3)
        )
        error = pm.HalfNormal("error", 4.0)
        prb.Simulator(
            "amount", amount, absorption, elimination, known, observed=readings,
            metric=prb.LogLikelihood(error=error), propagation=prb.Resimulated(),
        )  # fmt: skip
    return model, {"log_ka": log_ka, "is_fast": is_fast}


def main():
    """Print estimates beside published ones, and those of the two kinds of subjects."""
    optimum = prb.minimize(population(prb.datasets.theophylline()))
    estimates = {name: float(optimum.point[name]) for name in ("ka", "cl", "v", "error")}
    for name in ("ka", "cl", "v"):
        sigma = float(optimum.point[f"sigma_{name}"])
        estimates[f"cv_{name}"] = 100 * np.sqrt(np.exp(sigma**2) - 1)
    for name, (published, _) in PUBLISHED.items():
        print(f"{name:6s} {estimates[name]:7.3f}   published {published:7.3f}")
    model, truth = two_kinds()
    kinds = prb.minimize(model)
    log_ka, is_fast = truth["log_ka"], truth["is_fast"]
    slow, gap, share = (float(kinds.point[name]) for name in ("slow", "gap", "fast"))
    print(f"slow: {slow:.3f}, subjects {log_ka[~is_fast].mean():.3f}")
    print(f"fast: {slow + gap:.3f}, subjects {log_ka[is_fast].mean():.3f}")
    print(f"share: {share:.3f}, subjects {is_fast.mean():.3f}")


if __name__ == "__main__":
    main()
