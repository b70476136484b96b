"""Two-fidelity surfaces: a multiple of a coarse response, and a surface through the remainder.

References
----------
.. [1] Kennedy, M. C. and A. O'Hagan (2000), Predicting the output from a complex computer code when
   fast approximations are available, Biometrika 87, doi:10.1093/biomet/87.1.1.
.. [2] Perdikaris, P. et al. (2017), Nonlinear information fusion algorithms for data-efficient
   multi-fidelity modelling, Proc. R. Soc. A 473, doi:10.1098/rspa.2016.0751.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.emulators.surfaces import Predict, Surface, fitted, least_squares


@dataclass(frozen=True)
class MultifidelityModel:
    """The model of an output that follows a coarse response."""

    model: Any  # of the remainder beside the coarse response
    otherwise: Any  # of the response itself, where there is no coarse one
    joined: bool  # whether the coarse response is also an input of the remainder


@dataclass(frozen=True, eq=False)
class MultifidelitySurface:
    """A response as rho times a coarse one and a surface; a class, so that it can be pickled."""

    rho: float
    scaling: tuple[float, float] | None  # center and unit of a coarse response that is an input
    rest: Predict  # surface of the remainder

    def __call__(self, at: Floats, coarse: Floats) -> Floats:
        """Return responses, (k,), at points, (k, d), given the coarse ones."""
        return self.rho * coarse + self.rest(_points(at, coarse, self.scaling))


def fit_multifidelity(
    model: Any, x: Floats, y: Floats, coarse: Floats, *, joined: bool
) -> MultifidelitySurface:
    """Return a response (n,) at points (n, d) as a multiple of a finite coarse one, and a surface.

    A `Surface` estimates rho; ``joined`` makes the coarse response an input of the surface.
    """
    scaling = _scaling(x, coarse) if joined else None
    points = _points(x, coarse, scaling)
    rho = _rho(model, points, y, coarse)
    return MultifidelitySurface(rho, scaling, fitted(model, points, y - rho * coarse))


def tuned_for_remainder(model: Any, x: Floats, y: Floats, coarse: Floats, *, joined: bool) -> Any:
    """Return a model of a response with settings for the remainder beside a coarse one."""
    if not isinstance(model, Surface):
        return model
    points = _points(x, coarse, _scaling(x, coarse) if joined else None)
    # Settings for the response estimate rho from changes over short distances; a model with another
    # input has no settings yet.
    rho = _rho(None if joined else model, points, y, coarse)
    rest = y - rho * coarse
    return model.tuned(points, (rest - rest.mean()) / (rest.std() or 1.0))


def predict(
    model: Any,
    x: Floats,
    y: Floats,
    at: Floats,
    coarse: Floats | None = None,
    coarse_at: Floats | None = None,
) -> Floats:
    """Return predictions at points, (k,), of a surface through runs (n, d), (n,).

    A `MultifidelityModel` needs the coarse response at the runs, (n,), and the points, (k,), which
    is not finite where there is none.
    """
    if not isinstance(model, MultifidelityModel):
        return fitted(model, x, y)(at)
    assert coarse is not None
    assert coarse_at is not None
    has_coarse = np.isfinite(coarse)
    follows = np.isfinite(coarse_at)
    surface = fit_multifidelity(
        model.model, x[has_coarse], y[has_coarse], coarse[has_coarse], joined=model.joined
    )
    values = np.empty(len(at))
    values[follows] = surface(at[follows], coarse_at[follows])
    if not follows.all():
        values[~follows] = fitted(model.otherwise, x, y)(at[~follows])
    return values


def _rho(model: Any, x: Floats, y: Floats, coarse: Floats) -> float:
    """Return the factor of a coarse response in another one."""
    slope = model.slope if isinstance(model, Surface) else least_squares
    spread = coarse.std() or 1.0
    return float(slope(x, y, (coarse - coarse.mean()) / spread) / spread)


def _scaling(x: Floats, coarse: Floats) -> tuple[float, float]:
    """Return center and unit that give a coarse response the place and spread of the inputs."""
    spread = float(coarse.std() / x.std(axis=0).mean()) or 1.0
    return float(coarse.mean() - x.mean() * spread), spread


def _points(x: Floats, coarse: Floats, scaling: tuple[float, float] | None) -> Floats:
    """Return the inputs of a surface, with the coarse response if it is scaled."""
    if scaling is None:
        return x
    center, unit = scaling
    return np.column_stack([x, (coarse - center) / unit])
