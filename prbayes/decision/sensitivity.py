"""`sensitivity`: which hyperparameter, and which input's scatter, moves a decision quantity."""

from __future__ import annotations

import numpy as np
import pymc as pm
import xarray as xr
from scipy.special import ndtri

from prbayes._validate import Floats, Seed, flag, positive_integer, seed_number
from prbayes.decision.copula import Copula
from prbayes.decision.indices import (
    REPLICATES,
    Indices,
    derivative_bound,
    first_order,
    total_order,
)
from prbayes.decision.populations import Populations, Told
from prbayes.decision.quantities import Quantity, refuse_quantity
from prbayes.decision.scatter import scatter
from prbayes.model.fingerprint import as_attributes, identity_of_model
from prbayes.model.labels import versions
from prbayes.model.locking import in_turn
from prbayes.numerics.points import sobol
from prbayes.optimize.optimum import Optimum, identity_in
from prbayes.response.inputs import aleatory_names

# Draws of a posterior that are read: margins and correlations are then known to two percent.
_DRAWS = 4000
# Step of differences of weights, in standard deviations of an element of theta. Half or twice
# changes an index by less than a hundredth (tests/decision/test_sensitivity.py).
_WEIGHT_STEP = 0.02
# Share of populations that may have no finite number of the quantity, and are left out: shares are
# not known to a hundredth anyway.
_LEFT_OUT = 0.01


@in_turn
def sensitivity(
    result: Optimum | xr.DataTree,
    quantity: Quantity,
    *,
    model: pm.Model | None = None,
    n_samples: int = 1024,
    computed: bool = False,
    random_seed: Seed = 0,
) -> xr.Dataset:
    r"""Share out the uncertainty of a decision quantity, and the scatter of its response.

    The quantity Q is uncertain because the hyperparameters are. For each of them the table has
    the share of Q's variance that knowing it would remove on average (first order),
    :math:`S_i = Var(E[Q | \theta_i]) / Var(Q)`, the share that is left when all others are known
    (total order), :math:`T_i = E[Var(Q | \theta_{-i})] / Var(Q)`, and a bound of that from
    derivatives. Each Q costs weights and no response. The response scatters because inputs do:
    for each aleatory input the table has the same shares of the response's variance in the
    population at the centre of the result; of an `Exceedance` or a `Quantile` those of whether a
    specimen is beyond.

    Hyperparameters depend on each other in the posterior: shares then sum to more than one, or
    less, and the total may be smaller than the first order.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution; or with a ``posterior`` group, from any
        sampler.
    quantity : Quantity
        From ``prb.decision``, such as ``prb.decision.Quantile(response, x, probability=0.99)``.
        Another response than a simulator's is computed once for each run of the design, unless
        `predict` did that before.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    n_samples : int
        Populations from which those of each share are made, and a quarter of the specimens; the
        error falls with their number.
    computed : bool
        Whether the response is called at new specimens to share out its scatter, 4 ``n_samples``
        times (1 + 2 inputs + 2 numbers of a specimen) of them; by default emulators say it, or with
        one input the runs.
    random_seed : int, sequence of int, numpy.random.Generator or None

    Returns
    -------
    xarray.Dataset
        Dimension ``factor``, the elements of theta and the aleatory inputs, with ``kind``,
        "hyperparameter" or "input". Variables ``first``, ``total`` and ``derivative``, with their
        standard errors ``first_error``, ``total_error`` and ``derivative_error``: shares without a
        unit; NaN where they are not known, as derivatives of whether a specimen is beyond a limit.
        Attributes: ``quantity``, ``of_inputs`` (what of a specimen is shared out among the inputs),
        ``value`` (at the centre, in units of the quantity) and ``sd``
        (by the hyperparameters), ``scatter``, the share of a new specimen's variance that is
        scatter and no lack of knowledge, ``responses`` (how many were computed), ``inputs``, why
        shares of inputs are not known, and ``identity``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses.
    DesignError
        If the design does not support the populations.
    ResponseError
        If the response raises, or has the wrong shape.

    Notes
    -----
    The posterior is taken as a normal copula with its own margins: draws of an element given the
    others are exact where it is normal in unconstrained parameters. The derivative-based index of
    an element is :math:`s_i^2 E[(dQ/dz_i)^2] / Var(Q)`, where z are the normal numbers of
    the copula and s their standard deviations given all others; Poincaré's inequality for that
    conditional distribution makes it at least the total. An input that is a vector is one factor.

    References
    ----------
    .. [1] Saltelli, A. et al. (2010), Variance based sensitivity analysis of model output, Comput.
       Phys. Commun. 181, 259-270, doi:10.1016/j.cpc.2009.09.018.
    .. [2] Kucherenko, S., S. Tarantola and P. Annoni (2012), Estimation of global sensitivity
       indices for models with dependent variables, Comput. Phys. Commun. 183, 937-946,
       doi:10.1016/j.cpc.2011.12.020.
    .. [3] Sobol', I. M. and S. Kucherenko (2009), Derivative based global sensitivity measures and
       their link with global sensitivity indices, Math. Comput. Simul. 79, 3009-3017,
       doi:10.1016/j.matcom.2009.01.023.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1), name="x")
    ...     data = np.random.default_rng(1).normal(0, 1, 50)
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.ProbabilityResidual(), observed=data)
    >>> mean = prb.decision.Mean(np.sinh, x)
    >>> table = prb.sensitivity(prb.minimize(model), mean)
    >>> table.factor.values.tolist()
    ['mu', 'sigma', 'x']
    >>> bool(table.first.sel(factor="mu") > 0.9)
    True
    """
    caller = "prb.sensitivity"
    refuse_quantity(quantity, caller)
    n_samples = positive_integer(n_samples, "n_samples", minimum=2 * REPLICATES)
    flag(computed, "computed")
    seed = seed_number(random_seed)
    populations = Populations.of(result, model, _DRAWS, caller)
    told = populations.told(quantity.response, quantity.inputs, quantity.output)
    told.refuse_failed(quantity)
    own = _of_hyperparameters(told, quantity, n_samples, seed)
    inputs = scatter(told, quantity, n_samples, seed, computed=computed)
    evaluator = populations.evaluator
    simulator = evaluator.simulators[told.k]
    names = aleatory_names(simulator.inputs, simulator.responses.function)
    columns = {}
    for name in ("first", "total", "derivative"):
        for key in (name, f"{name}_error"):
            both = [getattr(own, key), getattr(inputs.indices, key)]
            columns[key] = ("factor", np.concatenate(both))
    kinds = ["hyperparameter"] * evaluator.size + ["input"] * len(names)
    identity = identity_in(result) or identity_of_model(evaluator.model)
    return xr.Dataset(
        columns,
        coords={"factor": [*evaluator.readable_names, *names], "kind": ("factor", kinds)},
        attrs={
            "quantity": repr(quantity),
            "value": float(told.at(quantity, populations.center[None])[0]),
            "sd": float(np.nanstd(told.at(quantity, populations.thetas))),
            "of_inputs": quantity.of_inputs,
            "scatter": _share_of_scatter(told, quantity),
            "responses": told.responses.count,
            "inputs": inputs.reason,
            "random_seed": str(seed),
            **as_attributes(identity),
            **versions(),
        },
    )


def _of_hyperparameters(told: Told, quantity: Quantity, n_samples: int, seed: int) -> Indices:
    """Return the indices of the elements of theta."""
    copula = Copula.of(told.populations.thetas)
    d = told.populations.evaluator.size
    n = n_samples // REPLICATES
    nets = [ndtri(sobol(n, 2 * d, seed + 7919 * r)) for r in range(REPLICATES)]
    here, fresh = np.split(np.array(nets), 2, axis=-1)
    z = here @ copula.root.T
    elsewhere = fresh @ copula.root.T

    def at(z: Floats) -> Floats:
        thetas = copula.thetas(z).reshape(-1, d)
        found = told.at(quantity, thetas)
        return found.reshape(z.shape[:-1])

    values = at(z)
    unknown = 1 - np.isfinite(values).mean()
    if unknown > _LEFT_OUT:
        raise ValueError(
            f"prb.sensitivity: {quantity!r}: got no finite number in {unknown:.1%} of the "
            f"populations, expected one in all but {_LEFT_OUT:.0%}; where specimens fail, ask for "
            "a smaller probability, or an Exceedance"
        )
    values = np.where(np.isfinite(values), values, np.nan)
    first = []
    total = []
    derivative = []
    steps = np.eye(d) * _WEIGHT_STEP / 2
    for i, (sd, step) in enumerate(zip(copula.conditional_sd, steps, strict=True)):
        without_others = at(copula.others_redrawn(z, elsewhere, i))
        first.append(first_order(values, without_others))
        without_it = at(copula.redrawn(z, fresh, i))
        total.append(total_order(values, without_it))
        change = at(z + step) - at(z - step)
        slopes = change / _WEIGHT_STEP
        derivative.append(derivative_bound((sd * slopes) ** 2, values))
    rows = [np.transpose(each) for each in (first, total, derivative)]
    return Indices.of(*rows)


def _share_of_scatter(told: Told, quantity: Quantity) -> float:
    """Return the share of a new specimen's variance that is there in each population."""
    populations = told.populations
    step = max(1, len(populations.thetas) // 400)
    thetas = populations.thetas[::step]
    (at,) = told.at(quantity, populations.center[None])
    numbers = quantity.of_specimen(told.values, at)
    if not np.isfinite(numbers).all():
        return np.nan
    weights = told.weights(thetas)
    away = numbers - numbers.mean()
    means = weights @ away
    within = np.nanmean(weights @ away**2 - means**2)
    between = np.nanvar(means)
    whole = within + between
    return float(within / whole) if whole > 0 else np.nan
