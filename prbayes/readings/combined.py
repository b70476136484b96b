"""A normal error with an additive part and a part that is proportional to the response."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from prbayes.readings.base import ReadingDistribution


@dataclass(frozen=True)
class Combined(ReadingDistribution):
    r"""A normal error with an additive and a proportional part.

    The standard deviation of a reading of the response f is :math:`\sqrt{a^2 + (b f)^2}`.

    Parameters
    ----------
    additive : float, array_like or model variable
        Standard deviation a, in units of the output: one number, one for each output, (m,), or one
        for each reading, (N,) or (N, m). A variable of the model is estimated.
    proportional : float, array_like or model variable
        Standard deviation b as a share of the response, likewise.

    Raises
    ------
    TypeError, ValueError
        If a part is no positive number.

    References
    ----------
    .. [1] Rocke, D. M. and S. Lorenzato (1995), A two-component model for measurement error in
       analytical chemistry, Technometrics 37, 176-184, doi:10.1080/00401706.1995.10484302.

    Examples
    --------
    >>> import prbayes as prb
    >>> prb.LogLikelihood(error=prb.readings.Combined(0.1, 0.05))
    LogLikelihood(error=Combined(additive=0.1, proportional=0.05))
    """

    additive: Any
    proportional: Any

    @property
    def roles(self) -> dict[str, Any]:
        """Both parts by role."""
        return {"error": self.additive, "relative": self.proportional}
