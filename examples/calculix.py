"""Which plates give these natural frequencies? CalculiX, two uncertain properties, 150 runs at most.

Cantilever plates of aluminium, 200 x 30 mm, differ in Young's modulus and in thickness. Measured
are the first bending frequency of each, across its thickness and in its plane: two outputs of one
run. The measured plates are synthetic, 40 of a known population, so that one sees whether it comes
out. The input file is made here, with places for the two properties; of the modes in the result
file those are taken that carry most mass in a direction, whatever their order.

Run: uv run python examples/calculix.py [--store FOLDER] [--out FOLDER]
"""

import argparse
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm

import prbayes as prb

LENGTH = 200.0  # mm; with MPa and t/mm3 frequencies are in Hz
WIDTH = 30.0
DENSITY = 2.7e-9  # t/mm3
ALONG = 20  # elements
ACROSS = 3  # elements
TRUTH = {"mean_gpa": 71.0, "sd_gpa": 1.5, "mean_mm": 2.95, "sd_mm": 0.05}
MEASURED = 40
MOST_RUNS = 150 - MEASURED


def input_file():
    """Return the input of a plate of shell elements, with the properties as fields."""
    number = {}
    nodes = []
    elements = []
    for i in range(2 * ALONG + 1):
        for j in range(2 * ACROSS + 1):
            if i % 2 == 0 or j % 2 == 0:  # elements of eight nodes have none in their middle
                number[i, j] = len(nodes) + 1
                x = LENGTH * i / (2 * ALONG)
                y = WIDTH * j / (2 * ACROSS)
                nodes.append(f"{number[i, j]}, {x:.6f}, {y:.6f}, 0.0")
    around = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    for i in range(0, 2 * ALONG, 2):
        for j in range(0, 2 * ACROSS, 2):
            corners = [str(number[i + di, j + dj]) for di, dj in around]
            elements.append(", ".join([str(len(elements) + 1), *corners]))
    clamped = [f"{number[0, j]}," for j in range(2 * ACROSS + 1)]
    return "\n".join(
        [
            *("*NODE", *nodes),
            *("*ELEMENT, TYPE=S8R, ELSET=PLATE", *elements),
            *("*NSET, NSET=CLAMPED", *clamped),
            *("*MATERIAL, NAME=ALUMINIUM", "*ELASTIC", "{modulus_gpa:.12f}E3, 0.33"),
            *("*DENSITY", f"{DENSITY}"),
            *("*SHELL SECTION, ELSET=PLATE, MATERIAL=ALUMINIUM", "{thickness_mm:.12e}"),
            *("*BOUNDARY", "CLAMPED, 1, 6"),
            *("*STEP", "*FREQUENCY", "8", "*END STEP", ""),
        ]
    )


def frequencies(folder):
    """Return the frequencies, Hz, of the modes with most mass across the plate and in its plane."""
    text = (folder / "plate.dat").read_text()
    values = table(text, "E I G E N V A L U E   O U T P U T")
    masses = table(text, "E F F E C T I V E   M O D A L   M A S S")
    in_plane = masses[:, 2].argmax()
    across = masses[:, 3].argmax()
    return {"across_hz": values[across, 3], "in_plane_hz": values[in_plane, 3]}


def table(text, title):
    """Return the rows of numbers below a title."""
    rows = []
    for line in text.split(title)[1].splitlines():
        words = line.split()
        if words and words[0].isdigit():
            rows.append([float(word) for word in words])
        elif rows:
            break
    return np.array(rows)


def beam(modulus_gpa, thickness_mm, width=WIDTH):
    """Return the first bending frequency of a slender cantilever in Hz, by formula."""
    speed = np.sqrt(modulus_gpa * 1e3 / DENSITY)
    return 1.8751**2 / (2 * np.pi) * thickness_mm / np.sqrt(12) * speed / LENGTH**2


def calibrate(plate, measured, threads, store):
    """Return the model, its optimum and its posterior."""
    with pm.Model() as model:
        modulus = pm.Normal.dist(
            pm.Normal("mean_gpa", 70, 5), pm.HalfNormal("sd_gpa", 3), name="modulus_gpa"
        )
        thickness = pm.Normal.dist(
            pm.Normal("mean_mm", 3.0, 0.2), pm.HalfNormal("sd_mm", 0.1), name="thickness_mm"
        )
        prb.Simulator(
            "frequencies", plate, modulus, thickness,
            metric=prb.Joint(prb.KullbackLeibler()), observed=measured,
            propagation=prb.Reweighted(
                64, max_points=MOST_RUNS, executor=threads, store=store,
                on_failure=prb.response.Retry(1, then=prb.response.Replace()),
            ),
        )  # fmt: skip
        optimum = prb.minimize()
        posterior = prb.sample_smc(500, chains=2, optimum=optimum, random_seed=1, progressbar=False)
    return model, optimum, posterior


def main():
    """Make measured plates, calibrate, and print what was found beside the truth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--store", default=None)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if shutil.which("ccx") is None:
        print("ccx is not on the path: install CalculiX, as by apt-get install calculix-ccx")
        return
    plate = prb.command(
        ["ccx", "plate"],
        inputs=["modulus_gpa", "thickness_mm"],
        write={"plate.inp": input_file()},
        read=frequencies,
        timeout=60,
    )
    first = plate.function(70.0, 3.0)
    print(f"one plate: {first['across_hz']:.1f} Hz, slender beam {beam(70.0, 3.0):.1f} Hz")
    rng = np.random.default_rng(3)
    moduli = rng.normal(TRUTH["mean_gpa"], TRUTH["sd_gpa"], MEASURED)
    thicknesses = rng.normal(TRUTH["mean_mm"], TRUTH["sd_mm"], MEASURED)
    with ThreadPoolExecutor(2) as threads, tempfile.TemporaryDirectory() as temporary:
        measured = pd.DataFrame(list(threads.map(plate.function, moduli, thicknesses)))
        store = arguments.store or temporary
        model, optimum, posterior = calibrate(plate, measured, threads, store)
    print(optimum.message)
    print(
        f"{optimum.search.n_computed} runs of the calibration, {MEASURED} for the measured plates"
    )
    print(f"{'':10} {'truth':>8} {'these plates':>13} {'optimum':>17} {'posterior':>17}")
    for (name, true), value in zip(
        TRUTH.items(),
        [moduli.mean(), moduli.std(ddof=1), thicknesses.mean(), thicknesses.std(ddof=1)],
        strict=True,
    ):
        draws = posterior.posterior[name]
        print(
            f"{name:10} {true:8.3f} {value:13.3f} {optimum.point[name]:9.3f} +- "
            f"{optimum.stderr[name]:.3f} {float(draws.mean()):9.3f} +- {float(draws.std()):.3f}"
        )
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        prb.plots.plot_outputs(posterior, model=model).savefig(arguments.out / "calculix.png")
        prb.plots.plot_population(posterior, model=model).savefig(
            arguments.out / "calculix_inputs.png"
        )


if __name__ == "__main__":
    main()
