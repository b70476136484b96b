"""A sampler object for `pymc.sample`: `Sampler`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pymc as pm
import xarray as xr
from pymc.stats.convergence import log_warnings, run_convergence_checks
from threadpoolctl import threadpool_limits

from prbayes._validate import Seed, called
from prbayes.posterior.sample import sample
from prbayes.posterior.smc import sample_smc
from prbayes.response.inputs import model_on_context

# PyMC's base class of sampler objects, in the versions that have one.
_BASE: Any = getattr(getattr(pm.sampling, "samplers", None), "Sampler", object)
# Arguments of a run, which are passed to `Sampler.sample_from_init`.
_OF_RUN = {"draws", "chains", "model", "cores", "return_inferencedata", "idata_kwargs", "var_names"}
_OF_RUN |= {"random_seed", "progressbar"}


class Sampler(_BASE):  # type: ignore[misc]
    """`prb.sample` or `prb.sample_smc` with its options, for ``pymc.sample(sampler=...)``.

    It implements the interface of PyMC's pull request 8358. Released versions of PyMC have no
    argument ``sampler`` yet: until then, call `sample_from_init`, or the function itself.

    Parameters
    ----------
    function : callable
        `prb.sample` or `prb.sample_smc`.
    **options
        Its arguments, such as ``optimum``, ``adjustment`` or ``max_seconds``, except those of
        `sample_from_init`.

    Raises
    ------
    TypeError
        If the function is another one, or an option is none of its arguments.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=[0.0, 2.0, 4.0])
    >>> sampler = prb.posterior.Sampler(prb.sample, max_seconds=600)
    >>> idata = sampler.sample_from_init(model=model, draws=200, random_seed=1, progressbar=False)
    >>> idata.posterior["mu"].shape
    (4, 200)
    """

    def __init__(self, function: Callable[..., xr.DataTree] = sample, **options: Any) -> None:
        if function not in (sample, sample_smc):
            raise TypeError(
                f"function: got {called(function)}, expected prb.sample or prb.sample_smc"
            )
        allowed = inspect.signature(function).parameters.keys() - _OF_RUN
        for name in options.keys() - allowed:
            of_run = "; it is an argument of pm.sample" if name in _OF_RUN else ""
            raise TypeError(
                f"options: got {name!r}, expected options of prb.{function.__name__}, of "
                f"{sorted(allowed)}{of_run}"
            )
        self.function = function
        self.options = options

    def __repr__(self) -> str:
        """Return the call that makes it."""
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        return f"Sampler(prb.{self.function.__name__}{options})"

    def sample_from_init(
        self,
        *,
        model: pm.Model | None = None,
        draws: int = 1000,
        tune: int | None = 1000,
        chains: int | None = None,
        cores: int | None = None,
        blas_cores: int | str | None = "auto",
        initvals: Any = None,
        random_seed: Seed = None,
        progressbar: bool = True,
        quiet: bool = False,
        discard_tuned_samples: bool = True,
        keep_warning_stat: bool = False,
        var_names: Sequence[str] | None = None,
        idata_kwargs: Mapping[str, Any] | None = None,
        compute_convergence_checks: bool = True,
    ) -> xr.DataTree:
        """Draw from the posterior of a model, with the arguments of `pymc.sample`.

        Parameters
        ----------
        model, draws, var_names, idata_kwargs, random_seed
            As in `prb.sample`.
        chains : int, optional
            Four by default.
        cores, blas_cores : int or "auto", optional
            Largest number of threads of linear algebra, ``blas_cores`` if it is a number: chains
            are drawn in this process.
        progressbar, quiet : bool
            With ``quiet`` there is no progress bar and no log of convergence checks.
        compute_convergence_checks : bool
            Whether R-hat and effective sample size are checked, as PyMC does.
        tune, initvals, discard_tuned_samples, keep_warning_stat
            At their defaults: nothing is tuned, and the sampler finds its own start.

        Returns
        -------
        xarray.DataTree
            The result of the function.

        Raises
        ------
        ValueError
            If an argument that does not apply is not at its default.
        """
        for name, value, defaults in (
            ("tune", tune, (None, 1000)),
            ("initvals", initvals, (None,)),
            ("discard_tuned_samples", discard_tuned_samples, (True,)),
            ("keep_warning_stat", keep_warning_stat, (False,)),
        ):
            if not any(value is default or value == default for default in defaults):
                raise ValueError(
                    f"{name}: got {value!r}, expected {defaults[0]!r}: {self!r} has no tuning and "
                    "no initial values; leave it out, or pass optimum= to the Sampler"
                )
        model = model_on_context(model, repr(self))
        with threadpool_limits(cores if blas_cores == "auto" else blas_cores):
            tree = self.function(
                draws,
                chains=4 if chains is None else chains,
                model=model,
                idata_kwargs=idata_kwargs,
                var_names=var_names,
                random_seed=random_seed,
                progressbar=bool(progressbar) and not quiet,
                **self.options,
            )
        names = {str(rv.name) for rv in model.free_RVs} & set(tree["posterior"].data_vars)
        if compute_convergence_checks and names and not quiet:
            log_warnings(run_convergence_checks(tree, model))
        return tree
