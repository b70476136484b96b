"""A response that runs an external program on several threads, with a store.

The deflection of beams under a given load calibrates the population of Young's modulus. The
measured deflections are synthetic: E ~ N(210, 7^2) GPa, 24 specimens. A second run of this script
runs the program not once.

Run: uv run python examples/external_program.py [--store FOLDER] [--points 64]
"""

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pymc as pm

import prbayes as prb

PROGRAM = Path(__file__).parent / "external" / "beam.py"
FORCE = 1000.0


def first_number(folder):
    """Return the deflection in millimetres that the program wrote."""
    return float((folder / "output.txt").read_text().split()[1])


def main():
    """Calibrate, and print optimum and posterior side by side."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--store", default="beam_responses")
    parser.add_argument("--points", type=int, default=64)
    arguments = parser.parse_args()
    deflection = prb.command(
        [sys.executable, "-S", PROGRAM, "input.txt", "output.txt"],
        inputs=["modulus_gpa", "force_n"],
        write={"input.txt": "modulus_gpa={modulus_gpa:.17g}\nforce_n={force_n:.17g}\n"},
        read=first_number,
        timeout=60,
    )
    modulus = np.random.default_rng(7).normal(210.0, 7.0, 24)
    measured = 1e3 * FORCE * 2.0**3 / (48 * modulus * 1e9 * 8.0e-7)
    with ThreadPoolExecutor(4) as threads, pm.Model() as model:
        mu = pm.Normal("mean_gpa", 200, 20)
        sigma = pm.HalfNormal("sd_gpa", 20)
        propagation = prb.Reweighted(
            arguments.points,
            executor=threads,  # the program runs outside Python, so threads will do
            store=arguments.store,  # nothing is computed twice, also in another run
            on_failure=prb.response.Retry(2, then=prb.response.Replace()),
        )
        E = pm.Normal.dist(mu, sigma)
        prb.Simulator(
            "deflection", deflection, E, FORCE,
            metric=prb.AreaMetric(), observed=measured, propagation=propagation,
        )  # fmt: skip
        optimum = prb.minimize()
        posterior = prb.sample(500, chains=2, optimum=optimum, random_seed=1, progressbar=False)
    print(f"{optimum.n_responses} runs of the program in all; "
          f"sample mean {modulus.mean():.1f} GPa, sd {modulus.std(ddof=1):.1f} GPa")  # fmt: skip
    table = prb.compare({"optimum": optimum, "posterior": posterior}, model=model)
    print(table[["estimate", "sd", "lower", "upper"]].to_dataframe().round(3))


if __name__ == "__main__":
    main()
