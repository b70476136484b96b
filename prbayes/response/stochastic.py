"""Random responses: a function that may return another value at each call."""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pymc as pm

from prbayes._validate import Function, Shape, positive_integer, wrong_value
from prbayes.response.call import scalar
from prbayes.response.response import refuse_misfit


class Stochastic:
    r"""A random response, whose distribution given the inputs is emulated from repeated runs.

    The function may return another value at each call with the same inputs, such as an agent-based
    model, a turbulent flow or a Monte Carlo code. With the log-likelihood by specimen,

    .. math:: \log L(\theta) = \sum_i \log \int p(y_i \mid x)\, p(x \mid \theta)\, dx,

    the density :math:`p(y \mid x)` is that of an emulator of the mean, of the spread, and of the
    density of the residuals, which may be skewed, and correlated between outputs. The error of the
    emulator by finitely many runs widens the posterior. A metric of distributions compares the
    readings with the runs themselves, under `Reweighted` or `Fresh`, and needs no repeats.

    Parameters
    ----------
    function : callable
        As for `Simulator`. Write ``prb.scalar(prb.response.Stochastic(f))`` for a function of one
        specimen.
    repeats : int
        Number of runs with the same inputs, at least 2.
    random_seed : int
        Seed of the `numpy.random.Generator` that a function with the argument ``rng`` gets. It is
        called for one specimen at a time, with arrays of length 1, each with a generator of its
        own, so that runs are the same on any number of workers. Another function has its own
        source of randomness.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Notes
    -----
    The distribution of the residuals has to be the same at all inputs, up to mean and spread, and
    between outputs up to their correlation; `prbayes.diagnose` tests it. A simulator gets one more
    input for the noise, standard normal, which predictions draw as well.

    References
    ----------
    .. [1] Rubin, D. B. (1981), The Bayesian bootstrap, Ann. Stat. 9, 130-134,
       doi:10.1214/aos/1176345338.
    .. [2] Baker, E. et al. (2022), Analyzing stochastic computer models: a review with
       opportunities, Stat. Sci. 37, 64-89, doi:10.1214/21-STS822.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> queue = prb.response.Stochastic(lambda x, rng: x + rng.gumbel(size=x.shape))
    >>> data = np.random.default_rng(0).normal(3.0, 1.5, 30)
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 3, 2), pm.HalfNormal("s", 2))
    ...     y = prb.Simulator("y", queue, x, observed=data)
    >>> queue
    prb.response.Stochastic(<lambda>, repeats=2, random_seed=0)
    """

    def __init__(self, function: Function, repeats: int = 2, *, random_seed: int = 0) -> None:
        label = "prb.response.Stochastic"
        if isinstance(function, scalar):
            raise TypeError(
                f"{label}: function: got a prb.scalar, expected the function of one specimen in "
                "it; write prb.scalar(prb.response.Stochastic(f)), with f = response.function"
            )
        if not callable(function) or isinstance(function, type):
            raise wrong_value(function, f"{label}: function", "a function of the inputs")
        if isinstance(function, Stochastic):
            raise TypeError(f"{label}: function: got a Stochastic, expected a plain function")
        self.function = function
        self.repeats = positive_integer(repeats, f"{label}: repeats", minimum=2)
        self.random_seed = positive_integer(random_seed, f"{label}: random_seed", minimum=0)
        # The numbers of a point would depend on its chunk if a chunk had one generator.
        self._has_generators = "rng" in _parameters(function)

    @property
    def _random_repeats(self) -> int:
        """Number of runs with the same inputs, by which simulators know a random response."""
        return self.repeats

    @property
    def __name__(self) -> str:
        return str(getattr(self.function, "__name__", type(self.function).__name__))

    def __repr__(self) -> str:
        seed = f", random_seed={self.random_seed}" if self._has_generators else ""
        return f"prb.response.Stochastic({self.__name__}, repeats={self.repeats}{seed})"

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs, with that of the noise."""
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        parameters = _parameters(self.function)
        names = [name for name, p in parameters.items() if p.kind in positional and name != "rng"]
        return (*names, "noise")

    def __call__(self, *inputs: Any) -> Any:
        """Return the response; the last input is the noise, which numbers runs."""
        *arguments, noise = inputs
        if not self._has_generators:
            return self.function(*arguments)
        numbers = [np.ascontiguousarray(x, dtype=np.float64) for x in (*arguments, noise)]
        digest = zlib.crc32(b"".join(x.tobytes() for x in numbers))
        return self.function(*arguments, rng=np.random.default_rng([self.random_seed, digest]))

    def refuse_misfit(self, name: str, sizes: Sequence[int], outputs: Any) -> None:
        """Raise if the function does not take the inputs."""
        function = self.function
        if self._has_generators:
            function = partial(function, rng=None)
        refuse_misfit(name, function, sizes[:-1], outputs)


def _parameters(function: Function) -> Mapping[str, inspect.Parameter]:
    """Return the parameters of a function, none if it does not declare them."""
    try:
        return inspect.signature(function).parameters
    except (TypeError, ValueError):
        return {}


def noise_of(event: Shape) -> Any:
    """Return the input for the noise of outputs of this shape: standard normal numbers."""
    noise = pm.Normal.dist(shape=event)
    noise.name = "noise"
    return noise
