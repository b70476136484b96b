"""Log-likelihood by specimen of a random response, whose distribution is emulated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from prbayes._validate import ArrayFunction
from prbayes.model.measurement import Measurement, SpecimenLikelihood
from prbayes.response.budget import RunCost
from prbayes.specimens.emulation import Emulation
from prbayes.specimens.points import SpecimenData
from prbayes.specimens.shared_points import (
    Noise,
    RandomResponse,
    RandomRunOptions,
    SharedPoints,
    shared_points,
)


def points_of_random_response(
    run: ArrayFunction,
    data: SpecimenData,
    likelihood: SpecimenLikelihood,
    earlier: Emulation | None,
) -> SharedPoints:
    """Return emulator, points and posterior draws of a random response.

    ``run`` returns outputs (n, m) at coordinates (n, d), ``earlier`` is the emulator for other
    specimens. Raises DesignError if the runs or the points do not suffice.
    """
    coordinates = likelihood.coordinates
    n_noise = len(data.output_names)
    noise = Noise(coordinates.center[-n_noise:], coordinates.half_width[-n_noise:])
    repeats = likelihood.measurements[0].responses.repeats
    return shared_points(RandomResponse(run, data, repeats, noise), earlier)


def random_cost(likelihood: SpecimenLikelihood, stated: int | None) -> RunCost:
    """Return the runs for the emulator of a random response; ``stated`` is the user's number."""
    (measurement,) = likelihood.measurements
    options, repeats = RandomRunOptions(), measurement.responses.repeats
    n_inputs = likelihood.coordinates.size - measurement.rows.shape[1]
    count = repeats * options.distinct_inputs(stated, n_inputs, repeats)
    growth = (
        f"in all, {repeats} with the same inputs; doubled, up to {max(options.most, count)}, until "
        "the readings do not choose between the emulators that the runs allow"
    )
    return RunCost(count, 0, max(options.most, count), growth)


def refuse_random(measurement: Measurement, partners: Sequence[SpecimenLikelihood]) -> None:
    """Raise TypeError for data that the likelihood of a random response does not take."""
    m, metric = measurement, measurement.metric
    labels, propagation = measurement.specimens, measurement.propagation
    label = f"{m.name}: response: got a random one (prb.response.Stochastic)"
    got = {
        "an unknown error or bias": bool(m.unknown),
        "gross_errors=": m.gross_errors is not False,
        "selected=": metric.selected is not None,
        "censored=": metric.censored is not None,
        "rounded=": metric.rounded is not None,
        "relative=True": bool(metric.relative) or bool(m.readings.relative.any()),
        "counts": metric.count is not None,
    }
    present = [text for text, is_given in got.items() if is_given]
    if present:
        raise TypeError(
            f"{label} and prb.LogLikelihood with {', '.join(present)}, expected exact readings or "
            "known normal errors; pass error= as a number, and leave the rest out"
        )
    if partners or (labels is not None and len(np.unique(labels)) < len(labels)):
        raise TypeError(
            f"{label} and several readings of a specimen, expected one row for each specimen; "
            "return all outputs from one response, with a column of observed= for each"
        )
    if propagation.calls_response:
        raise TypeError(
            f"{label} and {type(propagation).__name__}, expected prb.Reweighted(n): its "
            "distribution is emulated; leave propagation= out"
        )
