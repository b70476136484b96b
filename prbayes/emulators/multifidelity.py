"""Surfaces beside a coarse response: y is about rho times that, and a surface of what is left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.emulators.surfaces import Predict, Surface, fitted, least_squares


@dataclass(frozen=True)
class Following:
    """The choice of an output that follows a coarse response.

    Attributes
    ----------
    model : Surface or regressor
        Of what is beside the coarse response.
    otherwise : Surface or regressor
        Of the response itself, where there is no coarse one.
    joined : bool
        Whether what is beside depends on the coarse response, as on another input.
    """

    model: Any
    otherwise: Any
    joined: bool


@dataclass(frozen=True, eq=False)
class Followed:
    """A response as a multiple of a coarse one and a surface; a class, so that it can be pickled.

    Attributes
    ----------
    rho : float
        How much of the coarse response there is in this one.
    scaling : tuple of float, optional
        What is taken from a coarse response that is among the inputs, and by what it is divided.
    rest : callable
        What is beside it, from points to responses, shape (k,).
    """

    rho: float
    scaling: tuple[float, float] | None
    rest: Predict

    def __call__(self, at: Floats, coarse: Floats) -> Floats:
        """Return responses, (k,), at points, (k, d), given the coarse ones."""
        return self.rho * coarse + self.rest(_points(at, coarse, self.scaling))


def followed(model: Any, x: Floats, y: Floats, coarse: Floats, *, joined: bool) -> Followed:
    """Return a response on top of a coarse one.

    Parameters
    ----------
    model : Surface or regressor
        Of what is beside the coarse response. A surface finds rho.
    x : ndarray, shape (n, d)
    y, coarse : ndarray, shape (n,)
        Finite.
    joined : bool
        Whether the coarse response is among the inputs, too.

    References
    ----------
    .. [1] Kennedy, M. C. and A. O'Hagan (2000), Predicting the output from a complex computer code
       when fast approximations are available, Biometrika 87, doi:10.1093/biomet/87.1.1.
    .. [2] Perdikaris, P. et al. (2017), Nonlinear information fusion algorithms for data-efficient
       multi-fidelity modelling, Proc. R. Soc. A 473, doi:10.1098/rspa.2016.0751.
    """
    scaling = _scaling(x, coarse) if joined else None
    points = _points(x, coarse, scaling)
    rho = _rho(model, points, y, coarse)
    return Followed(rho, scaling, fitted(model, points, y - rho * coarse))


def tuned_beside(model: Any, x: Floats, y: Floats, coarse: Floats, *, joined: bool) -> Any:
    """Return a model that was tuned to a response with settings for what a coarse one leaves."""
    if not isinstance(model, Surface):
        return model
    points = _points(x, coarse, _scaling(x, coarse) if joined else None)
    # With settings for the response rho is told by what changes over short distances; one with
    # another input has none yet.
    rho = _rho(None if joined else model, points, y, coarse)
    rest = y - rho * coarse
    return model.tuned(points, (rest - rest.mean()) / (rest.std() or 1.0))


def predicted(
    model: Any,
    x: Floats,
    y: Floats,
    at: Floats,
    coarse: Floats | None = None,
    coarse_at: Floats | None = None,
) -> Floats:
    """Return what a surface, or a choice that follows a coarse response, says at points, (k,).

    Parameters
    ----------
    model : Following, Surface or regressor
    x : ndarray, shape (n, d)
    y : ndarray, shape (n,)
    at : ndarray, shape (k, d)
    coarse, coarse_at : ndarray, shapes (n,) and (k,), optional
        The coarse response at both; not finite where there is none.
    """
    if not isinstance(model, Following):
        return fitted(model, x, y)(at)
    assert coarse is not None
    assert coarse_at is not None
    known = np.isfinite(coarse)
    there = np.isfinite(coarse_at)
    surface = followed(model.model, x[known], y[known], coarse[known], joined=model.joined)
    found = np.empty(len(at))
    found[there] = surface(at[there], coarse_at[there])
    if not there.all():
        found[~there] = fitted(model.otherwise, x, y)(at[~there])
    return found


def _rho(model: Any, x: Floats, y: Floats, coarse: Floats) -> float:
    """Return how much of a coarse response there is in another one."""
    slope = model.slope if isinstance(model, Surface) else least_squares
    spread = coarse.std() or 1.0
    return float(slope(x, y, (coarse - coarse.mean()) / spread) / spread)


def _scaling(x: Floats, coarse: Floats) -> tuple[float, float]:
    """Return what gives a coarse response the place and spread of the inputs."""
    spread = float(coarse.std() / x.std(axis=0).mean()) or 1.0
    return float(coarse.mean() - x.mean() * spread), spread


def _points(x: Floats, coarse: Floats, scaling: tuple[float, float] | None) -> Floats:
    """Return points that a surface is over."""
    if scaling is None:
        return x
    center, spread = scaling
    return np.column_stack([x, (coarse - center) / spread])
