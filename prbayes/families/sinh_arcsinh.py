r"""Sinh-arcsinh populations: a normal or lognormal one with a skewness and tails of its own.

With :math:`z` standard normal, an input is

.. math:: x = \mu + s d \sinh\frac{\operatorname{arsinh} z + e}{d}, \qquad
    z = \sinh\Bigl(d \operatorname{arsinh} \frac{x - \mu}{s d} - e\Bigr),

with the skewness e and the tail d: tails are heavier than normal for d < 1 (Jones and Pewsey 2009).
The normal family is e = 0, d = 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.logprob.utils import CheckParameterValue
from pytensor import config
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import plain_text
from prbayes.response.inputs import model_on_context


class SinhArcsinhRV(RandomVariable):  # type: ignore[misc]
    """The sinh-arcsinh distribution, with parameters mu, s, skewness and tail."""

    name = "sinh_arcsinh"
    signature = "(),(),(),()->()"
    dtype = "floatX"
    _print_name = ("SinhArcsinh", "\\operatorname{SinhArcsinh}")
    # the family that the distribution contains, and the values of the parameters at which it is
    # this family, by position
    nested: ClassVar[tuple[str, Mapping[int, float]]] = ("normal", {2: 0.0, 3: 1.0})

    @classmethod
    def rng_fn(cls, rng: np.random.Generator, *arguments: Any) -> Any:
        """Draw inputs; the arguments are the four parameters and the shape."""
        *parameters, size = arguments
        shape = np.broadcast_shapes(*map(np.shape, parameters)) if size is None else size
        return _of_normal(np, rng.normal(size=shape), *parameters)


class LogSinhArcsinhRV(SinhArcsinhRV):
    """The distribution of a positive number whose logarithm is sinh-arcsinh."""

    name = "log_sinh_arcsinh"
    _print_name = ("LogSinhArcsinh", "\\operatorname{LogSinhArcsinh}")
    nested: ClassVar[tuple[str, Mapping[int, float]]] = ("lognormal", {2: 0.0, 3: 1.0})

    @classmethod
    def rng_fn(cls, rng: np.random.Generator, *arguments: Any) -> Any:
        """Draw inputs; the arguments are the four parameters and the shape."""
        return np.exp(super().rng_fn(rng, *arguments))


def _of_normal(xp: Any, z: Any, mu: Any, s: Any, skew: Any, tail: Any) -> Any:
    """Return the numbers whose normal scores are z, in NumPy or PyTensor."""
    return mu + s * tail * xp.sinh((xp.arcsinh(z) + skew) / tail)


def _arsinh_score(x: Any, mu: Any, s: Any, skew: Any, tail: Any) -> tuple[Any, Any]:
    """Return (x - mu) / (s tail), and the inverse hyperbolic sine of the normal score of x."""
    scaled = (x - mu) / (s * tail)
    return scaled, tail * pt.arcsinh(scaled) - skew


def _checked(value: Any, s: Any, tail: Any, *, is_log: bool = True) -> Any:
    """Return a graph that raises if a parameter is invalid; if it is a log, a model has -inf."""
    check = CheckParameterValue("s > 0, tail > 0", can_be_replaced_by_ninf=is_log)
    return check(value, pt.all(s > 0), pt.all(tail > 0))


class _SinhArcsinh(pm.Continuous):  # type: ignore[misc]
    """PyMC's functions of the distribution."""

    rv_op = SinhArcsinhRV()

    def support_point(rv: Any, size: Any, *parameters: Any) -> Any:  # noqa: N805 (as in PyMC)
        return pt.broadcast_to(_of_normal(pt, 0.0, *parameters), rv.shape)

    def logp(value: Any, mu: Any, s: Any, skew: Any, tail: Any) -> Any:  # noqa: N805
        scaled, score = _arsinh_score(value, mu, s, skew, tail)
        # Bounded, because infinity less infinity would be NaN.
        square = pt.minimum(pt.sinh(score) ** 2, 1e30)
        log_density = (pt.log((1 + square) / (1 + scaled**2)) - square - np.log(2 * np.pi)) / 2
        log_density -= pt.log(s)
        return _checked(log_density, s, tail)

    def logcdf(value: Any, mu: Any, s: Any, skew: Any, tail: Any) -> Any:  # noqa: N805
        _, score = _arsinh_score(value, mu, s, skew, tail)
        return _checked(pm.logcdf(pm.Normal.dist(), pt.sinh(score)), s, tail)

    def icdf(value: Any, mu: Any, s: Any, skew: Any, tail: Any) -> Any:  # noqa: N805
        x = _of_normal(pt, pm.icdf(pm.Normal.dist(), value), mu, s, skew, tail)
        return _checked(x, s, tail, is_log=False)


class _LogSinhArcsinh(pm.Continuous):  # type: ignore[misc]
    """PyMC's functions of the distribution of a positive number."""

    rv_op = LogSinhArcsinhRV()

    def support_point(rv: Any, size: Any, *parameters: Any) -> Any:  # noqa: N805
        return pt.exp(_SinhArcsinh.support_point(rv, size, *parameters))

    def logp(value: Any, *parameters: Any) -> Any:  # noqa: N805
        log_value = pt.log(value)
        log_density = _SinhArcsinh.logp(log_value, *parameters) - log_value
        return pt.switch(value > 0, log_density, -np.inf)

    def logcdf(value: Any, *parameters: Any) -> Any:  # noqa: N805
        return pt.switch(value > 0, _SinhArcsinh.logcdf(pt.log(value), *parameters), -np.inf)

    def icdf(value: Any, *parameters: Any) -> Any:  # noqa: N805
        return pt.exp(_SinhArcsinh.icdf(value, *parameters))


class SinhArcsinh:
    r"""A population that contains the normal one, with a skewness and tails to be calibrated.

    Intervals of its far quantiles remain honest where the population is not normal. Its mean and
    standard deviation are not ``mu`` and ``s``: `prbayes.population` reports them.

    Notes
    -----
    The density is that of Jones and Pewsey [1]_, scaled so that the spread of the middle does not
    depend on the tail d:

    .. math:: x = \mu + s d \sinh\frac{\operatorname{arsinh} z + e}{d}, \qquad z \sim N(0, 1).

    References
    ----------
    .. [1] Jones, M. C. and A. Pewsey (2009), Sinh-arcsinh distributions, Biometrika 96(4), 761-780,
       doi:10.1093/biomet/asp053.

    Examples
    --------
    >>> import pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     mu, s = pm.Normal("mu", 0, 2), pm.HalfNormal("s", 2)
    ...     x = prb.families.SinhArcsinh.dist(mu, s, name="x")
    >>> [variable.name for variable in model.free_RVs]
    ['mu', 's', 'x_skew', 'x_tail']
    """

    _distribution: ClassVar[Any] = _SinhArcsinh

    @classmethod
    def dist(
        cls,
        mu: Any,
        s: Any,
        *,
        name: str,
        skew: Any = None,
        tail: Any = None,
        **kwargs: Any,
    ) -> TensorVariable:
        """Return an input, and add its shape variables to the model on the context.

        Parameters
        ----------
        mu, s : tensor_like
            Location, and spread of the middle, in units of the input (of its logarithm for
            `LogSinhArcsinh`).
        name : str
            Name of the input. The shape variables are ``name_skew`` and ``name_tail``.
        skew, tail : tensor_like, optional
            By default new variables with the priors Normal(0, 0.35) and LogNormal(0, 0.25), without
            unit. A population is skewed to the right for skew > 0, and has heavier tails than the
            normal one for tail < 1.
        **kwargs
            As for the ``.dist()`` of PyMC, such as ``shape=``.

        Returns
        -------
        TensorVariable
            As the ``.dist()`` of a distribution of PyMC returns it.

        Raises
        ------
        TypeError
            If the name is no text, or there is no model on the context.
        ValueError
            If the name is empty, or the model has a shape variable of this name.
        """
        caller = f"prb.families.{cls.__name__}"
        plain_text(name, f"{caller}: name")
        model_on_context(None, caller)
        # The priors shrink towards the normal family. They were fixed before the study of coverage.
        if skew is None:
            skew = pm.Normal(f"{name}_skew", 0.0, 0.35)
        if tail is None:
            tail = pm.LogNormal(f"{name}_tail", 0.0, 0.25)
        # A number such as 2.0 would have single precision.
        parameters = [pt.as_tensor(p).astype(config.floatX) for p in (mu, s, skew, tail)]
        x = cls._distribution.dist(parameters, **kwargs)
        x.name = name
        return x


class LogSinhArcsinh(SinhArcsinh):
    """A positive population that contains the lognormal one: its logarithm is `SinhArcsinh`.

    Examples
    --------
    >>> import pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     life = prb.families.LogSinhArcsinh.dist(
    ...         pm.Normal("mu", 5, 1), pm.HalfNormal("s", 1), name="life"
    ...     )
    >>> [variable.name for variable in model.free_RVs]
    ['mu', 's', 'life_skew', 'life_tail']
    """

    _distribution = _LogSinhArcsinh
