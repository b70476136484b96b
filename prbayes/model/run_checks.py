"""Checks of the first runs against the log-likelihood by specimen, before any further run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.emulators.interpolant import fit_interpolant
from prbayes.metrics.readings import Readings
from prbayes.propagation.base import DesignError
from prbayes.propagation.roots import Response, Roots
from prbayes.response.failures import ResponseError


def refuse_scatter(
    name: str,
    outputs: Floats,
    alone: Callable[[int], Floats],
    *,
    rounding: float = 1e-6,
    one_system: float = 0.01,
) -> None:
    """Raise if the last good run differs when it is computed again: noise, or a hidden state.

    Parameters
    ----------
    name : str
    outputs : ndarray, shape (n, m)
        Of the first runs.
    alone : callable
        Row -> outputs of this run computed by itself, (m,).
    rounding : float
        Largest relative difference of two runs of one specimen.
    one_system : float
        Largest difference of a specimen by itself from the same among others, in standard
        deviations of the runs: the tolerance of a solver that takes the batch as one system.

    Raises
    ------
    ResponseError
    """
    finite = np.isfinite(outputs).all(axis=1)
    if finite.sum() < 2:
        return
    row = int(np.flatnonzero(finite)[-1])
    last, again = outputs[row], alone(row)
    accuracy = rounding * np.abs(outputs[finite]).max(axis=0)
    if not (np.abs(again - last) > accuracy).any():
        return
    differs = (np.abs(alone(row) - again) > accuracy).any()
    if not differs and not (np.abs(again - last) > one_system * outputs[finite].std(axis=0)).any():
        return
    j = int(np.nanargmax(np.abs(again - last) / np.where(accuracy > 0, accuracy, 1.0)))
    raise ResponseError(
        f"{name}: got outputs {last[j]:.6g} and {again[j]:.6g} of the same inputs, expected the "
        "same for prb.LogLikelihood(): the response has scatter of its own, or a state from one "
        "specimen to the next; fix its random seed or state, or use "
        "metric=prb.ProbabilityResidual() with propagation=prb.Resimulated()"
    )


def refuse_unreachable(name: str, outputs: Floats, readings: Readings) -> None:
    """Raise if the response is constant, or all readings are far outside the range of the runs.

    Far is more than the width of the range of the runs over all populations of the prior.

    Parameters
    ----------
    name : str
    outputs : ndarray, shape (n, m)
        Of the first runs.
    readings : Readings

    Raises
    ------
    DesignError
    """
    finite = outputs[np.isfinite(outputs).all(axis=1)]
    if len(finite) < 2:
        return
    low, high = finite.min(axis=0), finite.max(axis=0)
    size = np.abs(finite).max(axis=0)
    for j, width in enumerate(high - low):
        output = f"output {j} of {outputs.shape[1]}" if outputs.shape[1] > 1 else "the output"
        if width <= 1e-9 * size[j]:
            raise DesignError(
                f"{name}: got {high[j]:.6g} for {output} at all {len(finite)} runs, expected a "
                "response that depends on its inputs; check the response, or leave the output out"
            )
        values = readings.values[np.isfinite(readings.values[:, j]), j]
        if not values.size and readings.is_censored[:, j].any():
            raise DesignError(
                f"{name}: got no reading of {output} within the limits of censored=, expected at "
                "least one; leave the output out, or check the limits"
            )
        beyond = np.maximum(values - high[j], low[j] - values)
        if values.size and (beyond > width).all():
            raise DesignError(
                f"{name}: got readings from {values.min():.4g} to {values.max():.4g}, but "
                f"{low[j]:.4g} to {high[j]:.4g} for {output} at {len(finite)} runs over the range "
                "of the priors, expected ranges that overlap; check the units of the readings, "
                "the response and the priors"
            )


def unreached(outputs: Floats, readings: Readings) -> str:
    """Return a sentence about readings outside the range of the runs; empty if most are inside."""
    finite = outputs[np.isfinite(outputs).all(axis=1)]
    if not len(finite):
        return ""
    with np.errstate(invalid="ignore"):
        outside = (readings.values < finite.min(axis=0)) | (readings.values > finite.max(axis=0))
    count = int(outside.any(axis=1).sum())
    if 2 * count <= len(readings):
        return ""
    return (
        f". The readings of {count} of {len(readings)} specimens are outside the range of all "
        "runs over the priors: check the response, the priors and the units, or pass "
        "prb.LogLikelihood(error=...)"
    )


def refuse_undetermined(
    name: str, emulation: Any, roots: Roots, inputs: Sequence[str], smallest: float = 3.0
) -> None:
    """Raise if readings leave a direction of the inputs open, although there are enough outputs.

    Along such a direction the outputs change over half the prior's range by less than a few errors
    of the emulator.

    Parameters
    ----------
    name : str
    emulation : Emulation
    roots : Roots
    inputs : sequence of str
        Names of the coordinates.
    smallest : float
        Change in errors of the emulator, at the median root. Responses without such a direction
        have 97 and more, those with one less than .01.

    Raises
    ------
    DesignError
    """
    if len(inputs) < 2 or not len(roots.z):
        return
    response: Response = emulation
    _, jacobian = response(roots.z)
    scaled = jacobian / emulation.error[:, None]
    values, directions = _singular(scaled)
    if len(values) and np.median(values[:, -1]) < smallest:
        raise _undetermined(name, scaled.shape[1], directions, inputs)


def refuse_unused_inputs(
    name: str, z: Floats, outputs: Floats, inputs: Sequence[str], smallest: float = 1e-3
) -> None:
    """Raise if the first runs show a direction of the inputs without influence.

    Parameters
    ----------
    name : str
    z : ndarray, shape (n, d)
        Coordinates of the first runs.
    outputs : ndarray, shape (n, m)
    inputs : sequence of str
        Names of the coordinates.
    smallest : float
        Influence relative to the direction with the largest, at the median run. Responses of
        which all inputs matter have .05 and more, others 1e-4 and less.

    Raises
    ------
    DesignError
    """
    good = np.isfinite(outputs).all(axis=1)
    d, m = len(inputs), outputs.shape[1]
    if d < 2 or m < d or good.sum() < 4 * d:
        return
    z, outputs = z[good], outputs[good]
    surface = fit_interpolant(z, outputs, np.ones(len(z), dtype=bool))
    _, jacobian = surface(z)
    values, directions = _singular(jacobian / outputs.std(axis=0)[:, None])
    if len(values) and np.median(values[:, -1] / values[:, 0]) < smallest:
        raise _undetermined(name, m, directions, inputs)


def _singular(jacobian: Floats) -> tuple[Floats, Floats]:
    """Return singular values, (k, d), and right singular vectors, (k, d, d)."""
    finite = jacobian[np.isfinite(jacobian).all(axis=(1, 2))]
    if finite.shape[1] < finite.shape[2]:
        return np.empty((0, 0)), np.empty((0, 0, 0))
    _, values, directions = np.linalg.svd(finite)
    return values, directions


def _undetermined(name: str, m: int, directions: Floats, inputs: Sequence[str]) -> DesignError:
    weights = np.median(directions[:, -1] ** 2, axis=0)
    named = np.flatnonzero(weights > 0.05 * weights.max()).tolist()
    involved = ", ".join(inputs[j] for j in named)
    return DesignError(
        f"{name}: got {m} outputs that leave a direction of {involved} open, expected outputs that "
        f"determine the {len(inputs)} inputs of a specimen; make an input without influence a "
        "constant, replace inputs that enter only through their sum or product by it, or pass "
        "independent outputs alone"
    )


def emulator_findings(
    name: str, readings: Readings, error: Floats, largest: float = 0.03
) -> tuple[Finding, ...]:
    """Report an emulator whose error is not small beside the scatter of the readings.

    Parameters
    ----------
    name : str
    readings : Readings
    error : ndarray, shape (m,)
        Standard deviation of the emulator's error.
    largest : float
        In robust standard deviations of the readings. Jumps, poles and crossing modes with less
        have posterior means within .1 standard deviations (33 data sets, one of them .15).
    """
    share = error / readings.robust_spread()
    if not (share > largest).any():
        return ()
    return (
        Finding(
            "emulator-error",
            f"{name}: the emulator's error is up to {share.max():.2g} standard deviations of the "
            f"readings, expected at most {largest}: the response has a pole, a jump or a kink "
            "in the range of the priors, or more detail than the runs; posterior means may be off "
            "by more than .1 standard deviations. Narrow the priors, give more first runs with "
            "propagation=prb.Reweighted(n), or use metric=prb.ProbabilityResidual().",
            "likelihood.md#emulator-error",
        ),
    )
