"""Responses of the calibrated population, for any response and condition: `predict`."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from os import PathLike
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from prbayes._checks import Floats, positive_integer
from prbayes.estimate.optimum import Optimum
from prbayes.model.labels import versions
from prbayes.model.simulator import Node, model_on_context, nodes
from prbayes.model.support import TOLERABLE, DesignError, shortcoming
from prbayes.propagation.points import base_points
from prbayes.response.calling import ResponseError
from prbayes.response.compilation import compile_batched
from prbayes.response.distributions import PopulationSampler, quantiles
from prbayes.response.inputs import Inputs, read_inputs
from prbayes.response.response import Responses, refuse_uncallable

_log = logging.getLogger("prbayes")


def predict(
    result: Optimum | xr.DataTree,
    response: Callable[..., Any],
    *inputs: Any,
    model: pm.Model | None = None,
    n_samples: int = 500,
    draws: int = 400,
    stored: bool = True,
    name: str | None = None,
    executor: Executor | None = None,
    store: str | PathLike[str] | None = None,
    random_seed: int | None = 0,
) -> xr.DataArray:
    """Draw responses of the calibrated population, also of another response or under another condition.

    Each draw of the posterior is a population of its own, of which ``n_samples`` specimens are drawn; an
    optimum is one population. Where the model has a simulator with `Reweighted` and the same ``.dist()``
    objects, the specimens are its design points, resampled by their weights: its own response then costs
    nothing, and any other one is computed once per design point, not once per draw, specimen or call. Elsewhere
    specimens are new: Sobol points through the inverse distribution functions, with another shift for each
    draw, or random draws where there is no inverse.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group that has the model's free variables, from `sample_smc`,
        `bootstrap` or any PyMC sampler.
    response : callable
        As for `Simulator`; +inf is a specimen that failed, NaN a point that could not be computed.
    *inputs
        ``.dist()`` objects of the model's simulators, or new ones over the model's variables; model variables;
        constants.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    n_samples : int
        Specimens from each population.
    draws : int
        Largest number of populations, over all chains; the posterior's draws are thinned evenly.
    stored : bool
        Whether design points may serve. With False the response is computed for draws x n_samples specimens.
    name : str, optional
        Of the result; by default that of the function.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    store : path-like, optional
        A folder that keeps every computed response, by ``name``.
    random_seed : int, optional

    Returns
    -------
    xarray.DataArray
        Dims (chain, draw, sample). Attributes: ``source`` (how specimens were made), ``responses`` (how many were
        computed), ``nan`` (how many values are NaN), ``specimens_id`` (equal for predictions with the same
        specimens), ``calibration_data`` and ``calibration_specimens`` (digests of the data, and specimen labels, of
        the calibration, by which `area_test` knows them).

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or the result lacks a free variable.
    DesignError
        If the design points do not support the populations.
    ResponseError
        If the response raises, has the wrong shape, or is NaN everywhere.

    Notes
    -----
    With the same ``result``, inputs, ``n_samples``, ``draws`` and ``random_seed``, sample i of a draw is the same
    specimen, whatever the response: predictions of several conditions can be set against repeated
    measurements. Where two simulators of the model have designs of their own, pass ``stored=False``.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> squares = prb.predict(prb.minimize(model), np.square, x, random_seed=1)
    >>> squares.name, squares.shape, squares.attrs["responses"]
    ('square', (1, 1, 500), 1024)
    """
    refuse_uncallable("prb.predict", response)
    positive_integer(n_samples, "n_samples", minimum=2)
    positive_integer(draws, "draws")
    if model is None and isinstance(result, Optimum):
        model = result.model
    model = model_on_context(model, "prb.predict")
    label = name or str(getattr(response, "__name__", type(response).__name__))
    if store is not None and name is None and not label.isidentifier():
        raise ValueError(f"name: got a store for a function called {label}, expected a name to keep its responses by")
    points, coords = populations_of(result, model, draws, "prb.predict")
    sorted_inputs = read_inputs(label, inputs, model)
    responses = Responses(label, response, sorted_inputs, executor=executor, store=store)
    rng = np.random.default_rng(random_seed)
    node = serving(list(nodes(model).values()), responses) if stored else None
    if node is not None:
        design = node.design
        assert design is not None
        chosen = _resampled(node, [points[str(r.name)] for r in design.inputs.roots], n_samples, rng)
        values = design.values_of(responses)[chosen]
        specimens = [x[chosen] for x in design.points_of(sorted_inputs)]
        source = f"{'design points' if responses.count else 'stored responses'} of {node.name}"
    else:
        roots = [points[str(r.name)] for r in sorted_inputs.roots]
        specimens, epistemic = _new_specimens(label, sorted_inputs, roots, n_samples, rng)
        values, source = responses(specimens, epistemic), "new specimens"
    bad = int(np.isnan(values).sum())
    if bad == values.size:
        raise ResponseError(f"{label}: got NaN at all {bad} specimens, expected numbers; +inf is a specimen that fails")
    if bad:
        _log.warning("%s: %d of %d predicted responses are NaN", label, bad, values.size)
    return xr.DataArray(
        values.reshape(len(coords["chain"]), len(coords["draw"]), n_samples),
        dims=("chain", "draw", "sample"),
        coords={**coords, "sample": np.arange(n_samples)},
        name=label,
        attrs={
            "source": source,
            "responses": responses.count,
            "nan": bad,
            "specimens_id": _digest(*specimens),
            "random_seed": str(random_seed),
            **_calibration(result, model),
            **versions(),
        },
    )


def populations_of(
    result: Any, model: pm.Model, draws: int, caller: str
) -> tuple[dict[str, Floats], dict[str, NDArray[Any]]]:
    """Return values of the free variables, (k, *shape) by name, and coordinates of chain and draw."""
    names = [str(rv.name) for rv in model.free_RVs]
    if isinstance(result, Optimum):
        known: Any = result.point
        coords = {"chain": np.arange(1), "draw": np.arange(1)}
    elif isinstance(result, xr.DataTree) and "posterior" in result:
        known = result["posterior"].to_dataset()
        each = max(1, draws // known.sizes["chain"])
        size = known.sizes["draw"]
        known = known.isel(draw=np.unique(np.linspace(0, size - 1, min(size, each)).round().astype(int)))
        coords = {dim: np.asarray(known[dim]) for dim in ("chain", "draw")}
    else:
        raise TypeError(
            f"{caller}: got {type(result).__name__}, expected an Optimum from prb.minimize, or a DataTree with a "
            "posterior group, such as prb.sample_smc returns"
        )
    missing = [n for n in names if n not in known]
    if missing:
        raise KeyError(f"{caller}: got a result without {missing}, expected the model's free variables {names}")
    if isinstance(result, Optimum):
        return {n: np.asarray(known[n], dtype=np.float64)[None] for n in names}, coords
    arrays = {n: known[n].transpose("chain", "draw", ...).values for n in names}
    return {n: a.reshape(-1, *a.shape[2:]) for n, a in arrays.items()}, coords


def serving(among: Sequence[Node], responses: Responses) -> Node | None:
    """Return the simulator whose design points are specimens of these inputs: best the one with this response."""
    wanted = responses.inputs
    able = [
        n
        for n in among
        if n.bound.stored
        and not wanted.epistemic
        and all(any(x is y for y in n.bound.inputs.aleatory) for x in wanted.aleatory)
    ]
    return next((n for n in able if responses.same_as(n.bound.responses)), able[0] if able else None)


def _resampled(node: Node, roots: list[Floats], n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return design points of n specimens for each population, (k, n): systematic resampling, in random order."""
    design = node.design
    assert design is not None
    support = design.support(roots)
    ess, mass = np.median(support["weight_ess"]), np.median(support["mean_weight"])
    # Points without response become NaN, which are counted and said by themselves.
    if shortcoming(support, design.required_ess, 1.0, design.n_points, TOLERABLE):
        raise DesignError(
            f"{node.name}: got a weight effective sample size of {ess:.0f} and a mean raw weight of {mass:.2f} "
            f"(medians over the populations), expected {design.required_ess:.0f} and 1; call prb.refine(model) and "
            "sample again, or pass stored=False, which computes responses of new specimens"
        )
    _, weights = design.populations(roots)
    cumulative = np.cumsum(np.nan_to_num(weights), axis=1)
    cumulative /= np.maximum(cumulative[:, -1:], 1e-300)
    places = (np.arange(n) + rng.random((len(weights), 1))) / n
    found = np.array([np.searchsorted(c, u) for c, u in zip(cumulative, places, strict=True)])
    return rng.permuted(np.minimum(found, design.n_points - 1), axis=1)


def _new_specimens(
    label: str, inputs: Inputs, roots: list[Floats], n: int, rng: np.random.Generator
) -> tuple[list[Floats], list[Floats]]:
    """Return aleatory values, shapes (k, n, *event), and epistemic ones that broadcast against them."""
    symbols = inputs.placeholders()
    try:
        if inputs.nested:
            raise TypeError("no inverse of a conditional distribution")
        dists, epistemic = inputs.rebuilt(symbols)
        uniforms = [pt.tensor(dtype="float64", shape=(None, *s)) for s in inputs.event_shapes]
        placed = [quantiles(label, d, u) for d, u in zip(dists, uniforms, strict=True)]
    except TypeError:
        return PopulationSampler(inputs)(roots, n, rng)
    _, base = base_points(inputs, n, int(rng.integers(2**31)))
    order = rng.permutation(n)
    shifted = [(b[order] + rng.random((len(roots[0]), 1, *b.shape[1:]))) % 1 for b in base]
    function = compile_batched([*symbols, *uniforms], [*placed, *epistemic])
    values = function(*roots, *(np.clip(u, 1e-12, 1 - 1e-12) for u in shifted))
    return values[: len(placed)], [v[:, None] for v in values[len(placed) :]]


def specimen_names(labels: ArrayLike) -> list[str]:
    """Return labels as text, the same for 3 and 3.0."""
    plain = np.asarray(labels).tolist()
    return [str(int(x)) if isinstance(x, float) and x.is_integer() else str(x) for x in plain]


def data_digest(observed: Floats) -> str:
    """Return what identifies a set of measured values, in any order."""
    return _digest(np.sort(observed))


def _digest(*arrays: Floats) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
    return found.hexdigest()[:16]


def _calibration(result: Optimum | xr.DataTree, model: pm.Model) -> dict[str, list[str]]:
    """Return attributes that tell on what data the result was calibrated."""
    simulators = result.evaluator.nodes if isinstance(result, Optimum) else list(nodes(model).values())
    labels: dict[str, None] = {}
    digests = []
    for node in simulators:
        data = node.target.observed
        if isinstance(result, xr.DataTree) and "observed_data" in result and node.name in result["observed_data"]:
            data = np.asarray(result["observed_data"][node.name])
        digests.append(data_digest(data))
        labels |= dict.fromkeys([] if node.specimens is None else specimen_names(node.specimens))
    found = {"calibration_data": digests, "calibration_specimens": list(labels)}
    return {key: value for key, value in found.items() if value}
