"""Whether the runs of a table or surrogate are where the specimens and their populations are.

The cross-validated error of a surface is measured at its runs. It is that at a specimen only if the
specimen is about as near to a run as the runs are to each other.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from prbayes._finding import Finding
from prbayes._validate import Bools, Floats
from prbayes.emulators.ranges import Ranges
from prbayes.emulators.runs import Runs
from prbayes.emulators.surrogate import Surrogate
from prbayes.model.measurement import Measurement, SpecimenLikelihood, observed_range
from prbayes.propagation.base import MAX_LOST
from prbayes.specimens.emulation import near_readings
from prbayes.specimens.points import SpecimenData, SpecimenPoints, likely_weights, normal_of

_PAGE = "runs.md#where-the-runs-are"


def coverage_findings(
    likelihood: SpecimenLikelihood,
    data: SpecimenData,
    points: SpecimenPoints,
    specimens: Floats,
    farthest: float = 2.0,
    beyond: float = 0.005,
) -> list[Finding]:
    """Report runs of tables and surrogates that are not where the specimens or populations are.

    ``specimens``, (n, d), are coordinates of specimens of the posterior's populations. ``farthest``
    is in units of the distance that 90 % of the runs have at most from each other. Of 60 data sets
    of 20 normal specimens in the middle of 30 or 100 runs it was exceeded in none with grids, Sobol
    points and Latin hypercubes, in 0 to .12 with uniform random runs, and in all with a hole of .3
    of the range of one input. ``beyond`` is the largest share of the populations that is beyond the
    runs, and may have the readings of specimens.
    """
    findings = []
    for m in likelihood.measurements:
        function = m.responses.function
        surrogate = function.surrogate if isinstance(function, Runs) else function
        if not isinstance(surrogate, Surrogate):
            continue
        remedy = "fit the surrogate to more runs there"
        if function is not surrogate:
            remedy = "add the runs that prb.propose_runs(model) returns"
        weights = likely_weights(data, points, normal_of(specimens[:, data.free]))
        z = points.z.reshape(-1, points.z.shape[-1])
        distance = _relative_distance(surrogate, m, _columns(likelihood, m, surrogate.domain, z))
        by_specimen = (weights * distance.reshape(weights.shape)).sum(axis=1)
        is_far = by_specimen > farthest
        if is_far.mean() >= MAX_LOST:
            text = (
                f"{m.name}: got {is_far.sum()} of {len(is_far)} specimens up to "
                f"{by_specimen.max():.2g} times as far from the nearest run as runs are from each "
                f"other, expected at most {farthest:g}: the error of the surface is not "
                f"known there; {remedy}."
            )
            findings.append(Finding("sparse-runs", text, _PAGE))
        columns = _columns(likelihood, m, surrogate.domain, specimens)
        is_beyond = surrogate.domain.outside(columns)
        share = float(np.mean(is_beyond.any(axis=1) & _may_be_measured(surrogate, m, columns)))
        if share > beyond:
            place = surrogate.domain.complaint(columns, is_beyond).partition("design: ")[2]
            text = (
                f"{m.name}: {share:.1%} of the populations are beyond the runs, where the response "
                f"may be that of specimens, expected at most {beyond:.1%}: got {place}; "
                f"{remedy}, or restrict the distribution of the inputs."
            )
            findings.append(Finding("beyond-runs", text, _PAGE))
    return findings


def _columns(likelihood: SpecimenLikelihood, m: Measurement, domain: Ranges, z: Floats) -> Floats:
    """Return the inputs of a surrogate at coordinates, (k, d) -> (k, columns)."""
    inputs = m.responses.inputs.fill(likelihood.coordinates.inputs(z), [])
    return domain.columns(inputs)[0]


def _relative_distance(surrogate: Surrogate, m: Measurement, columns: Floats) -> Floats:
    """Return distances from the nearest run, (k,), in units of distances between runs.

    The unit is the 90 % quantile at the runs whose response is near the readings. An input with few
    different values, as in a grid, has their typical step as its unit.
    """
    usable = surrogate._surface.usable
    runs = surrogate._surface.unit[usable]
    values = surrogate.responses.reshape(len(usable), -1)[usable]
    steps = np.array([np.median(np.diff(np.unique(column))) for column in runs.T])
    tree = cKDTree(runs / steps)
    is_near = near_readings(values, m.readings)
    between = tree.query(runs[is_near] / steps, k=2)[0][:, 1]
    unit = np.clip(surrogate.domain.scaled(columns), -9, 9)
    return np.asarray(tree.query(unit / steps)[0] / np.quantile(between, 0.9))


def _may_be_measured(surrogate: Surrogate, m: Measurement, columns: Floats) -> Bools:
    """Return whether the response at the end of the ranges is within a tenth of the readings."""
    domain = surrogate.domain
    unit = np.clip(np.nan_to_num(domain.scaled(columns), nan=0.5), 0, 1)
    values = surrogate._surface(domain.at(unit)).reshape(len(unit), -1)
    low, high = observed_range(m)
    margin = (high - low) / 10
    return np.asarray(((values >= low - margin) & (values <= high + margin)).all(axis=1))
