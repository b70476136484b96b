"""Refinement of the designs of `Reweighted`: more points where the populations that matter live."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Information, Local
from prbayes.inference.design_error import DesignErrors
from prbayes.inference.identifiability import oriented
from prbayes.inference.resampling import families, siblings
from prbayes.model.coverage import Shortcoming, shortcomings
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import THETAS
from prbayes.optimize.convergence import apart_from_data, areas
from prbayes.propagation.base import DesignError
from prbayes.propagation.reweighted import ReweightedBound, designs_restored

_log = logging.getLogger("prbayes")
# Batches added before a design is refused: by judgement; half or twice changes no answer
# (docs/constants.md).
MAX_ROUNDS = 8
# Standard errors within which the optima of two independent designs are to be: a tenth adds half a
# per cent to the width of an interval.
AGREE = 0.1
# The power of its size with which the error of a design of several inputs falls, about; it only
# says how many points are added at a time (benchmarks/dimensions.py).
_RATE = 0.65
# Share of that which points and emulators may have each: together they then have it all.
_OF_EACH = np.sqrt(0.5)
# Most by which a design grows at a time: the estimate of its error is itself uncertain.
_GROWTH = 2.0
# Step of a pilot, in standard deviations of the thetas kept: small against their spread, so that
# the next ones are within reach of the design. Half or twice leads to another design, and moves an
# optimum within that design's own error (docs/constants.md).
_PILOT_STEP = 0.4
# Error of an emulator, in the response's spread, from which on runs are added on the way: what is
# minimised is then another response. By judgement, as it only leads the way.
_UNTOLD = 0.25
# Data sets that tell a noise floor which only says when a pilot stops, or when optima are compared.
FEW_SETS = 50


def refine_at(
    evaluator: Evaluator, thetas: Floats, *, beside: Floats | None = None, again: bool = False
) -> dict[str, Shortcoming]:
    """Add one batch to each design that falls short at thetas, (P, d); return what was short.

    A cloud is drawn anew for them, and for those that it is to support ``beside`` them; it is
    larger where that was done before (``again``).

    Raises
    ------
    DesignError
        If too many points have no response, of which more points would have no more.
    """
    short = shortcomings(evaluator, thetas)
    for name, what in short.items():
        if what.lost is not None:
            raise DesignError(
                f"{name}: {what}; repair the response there, return +inf for specimens that fail, "
                "narrow the priors, or raise max_lost"
            )
    thin = set(short)
    every = thetas if beside is None else np.concatenate([thetas, beside])
    drawn = _widened(evaluator, every, thin) if again else _reach(evaluator, every, thin)
    while drawn and thin:
        thin &= set(shortcomings(evaluator, thetas))
        drawn = _widened(evaluator, every, thin, on_the_way=True)
    # What no cloud reaches needs runs, and so does what no emulator tells.
    _add(evaluator, every, thin | _untold(evaluator, set(short)))
    return short


def _untold(evaluator: Evaluator, names: set[str]) -> set[str]:
    """Return the designs, of those named, whose emulators say little where the last points went."""
    found = set()
    for name in names:
        emulator = evaluator.reweighted[name].design.emulator
        if emulator is not None and emulator.error > _UNTOLD:
            found.add(name)
    return found


def grow(evaluator: Evaluator, thetas: Floats, errors: DesignErrors) -> bool:
    """Add points to all designs until their error is expected to be small enough.

    Parameters
    ----------
    evaluator : Evaluator
    thetas : ndarray, shape (P, d)
        Where the populations live that matter.
    errors : DesignErrors
        Differences between the optima of independent designs.

    Returns
    -------
    bool
        Whether any were added.
    """
    _log.info(
        "the optima of independent designs would differ by %.2f standard errors, more than the "
        "%.2f that are left to them: designs are refined",
        errors.whole,
        AGREE,
    )
    clouds = {name for name, bound in evaluator.reweighted.items() if bound.design.is_emulated}
    if _needs_runs(evaluator, errors):
        names = set(evaluator.reweighted)
        # A cloud is then drawn anew for these populations; whether that is enough is seen next.
        if _add(evaluator, thetas, names, min(_GROWTH, _factor(errors.whole))):
            return True
    # Points of clouds cost no run.
    short = clouds and errors.points > _OF_EACH * AGREE
    return bool(short) and _widened(evaluator, thetas, clouds)


def runs_left(evaluator: Evaluator, errors: DesignErrors) -> int:
    """Return how many more runs are expected until designs' error is small enough."""
    if not _needs_runs(evaluator, errors):
        return 0
    more = _factor(errors.whole) - 1
    left = 0.0
    for bound in evaluator.reweighted.values():
        left += min(more * bound.n_runs, max(0, bound.config.most - bound.n_runs))
    return round(left)


def _needs_runs(evaluator: Evaluator, errors: DesignErrors) -> bool:
    """Return whether more runs make designs' error smaller."""
    emulated = all(bound.design.is_emulated for bound in evaluator.reweighted.values())
    return not emulated or errors.emulators > _OF_EACH * AGREE


def _factor(error: float) -> float:
    """Return by how much designs have to grow for an error to become small enough."""
    return float((error / AGREE) ** (1 / _RATE))


def _add(evaluator: Evaluator, thetas: Floats, names: set[str], factor: float = 1.0) -> bool:
    """Add one batch to the designs named, and to those of simulators that share their specimens.

    The batch has the design's first size, or brings the whole to ``factor`` times what it was.
    Returns whether ``max_points`` left room for any.
    """
    names = siblings(evaluator.nodes, names)
    added: list[str] = []
    for k, node in enumerate(evaluator.nodes):
        bound = node.reweighted
        if bound is None or node.name not in names:
            continue
        now = bound.n_runs
        first = bound.batch_size
        batches = max(1, round((factor - 1) * now / first))
        room = bound.config.most - now
        size = min(batches * first, room)
        if size > 0:
            bound.add(_components(evaluator, thetas, k), size)
            added.append(f"{node.name} from {now} to {bound.n_runs}")
    if added:
        _log.info("refined: %s runs", ", ".join(added))
    return bool(added)


def _components(evaluator: Evaluator, thetas: Floats, k: int) -> list[Floats]:
    """Return the populations at thetas for which a design has points: those of all its groups."""
    own = next((family for family in families(evaluator.nodes) if k in family), [k])
    of_each = [evaluator.roots(thetas, member) for member in own]
    return [np.concatenate(values) for values in zip(*of_each, strict=True)]


def pilot(evaluator: Evaluator, scales: Floats, *, seed: int = 0) -> Floats:
    """Lead a design that is far too thin from the prior to where the discrepancy is small.

    Each step keeps the best quarter of the thetas and, where the design is thin there, adds points
    from their populations before it looks closer: the kept thetas are never far from its reach.

    Returns
    -------
    ndarray, shape (256, d)
        Thetas whose discrepancies differ by no more than sampling noise.
    """
    rng = np.random.default_rng(seed)
    thetas = evaluator.hyperparameters.prior_thetas(4 * THETAS, seed)
    for _ in range(2 * MAX_ROUNDS):
        # Keep the best.
        found = evaluator(thetas)
        total = (found.discrepancies / scales).sum(axis=-1)
        value = total - found.log_other
        value = np.where(np.isfinite(found.log_prior), value, np.inf)
        order = np.argsort(value)[:THETAS]
        apart = apart_from_data(evaluator, thetas[order[0]])
        if apart:
            # The discrepancy is then the same everywhere, up to rounding.
            order = np.argsort(areas(evaluator, scales, thetas))[:THETAS]
        best = thetas[order]
        # Let the designs reach them.
        thin = _thin(evaluator, best)
        _reach(evaluator, best, thin, on_the_way=True)
        growing = {name for name in thin if _has_room(evaluator.reweighted[name])}
        _add(evaluator, best, growing)
        # Stop where sampling explains the differences that are left.
        spread = value[order[-1]] - value[order[0]]
        noise = sum(noise_floors(evaluator, best[0], FEW_SETS) / scales)
        if not (thin or apart) and spread < noise:
            break
        # Step on, from each of them at random.
        covariance = np.atleast_2d(np.cov(best, rowvar=False))
        # A share of each variance is added, so that there is a root.
        share = 1e-12 * np.diag(np.diag(covariance))
        root = np.linalg.cholesky(covariance + share)
        chosen = rng.integers(len(best), size=4 * THETAS)
        parents = best[chosen]
        z = rng.standard_normal(parents.shape)
        thetas = parents + _PILOT_STEP * z @ root.T
    return best


def _clouds(evaluator: Evaluator, names: set[str]) -> Iterator[tuple[int, ReweightedBound]]:
    """Yield designs with a cloud, by position of their simulators, of those named.

    And of those that share their specimens, whose points stay the same ones.
    """
    together = siblings(evaluator.nodes, names)
    for k, node in enumerate(evaluator.nodes):
        bound = node.reweighted
        if bound is not None and bound.design.is_emulated and node.name in together:
            yield k, bound


def _reach(
    evaluator: Evaluator, thetas: Floats, names: set[str], *, on_the_way: bool = False
) -> bool:
    """Let clouds reach the populations at thetas; return whether there are any."""
    clouds = list(_clouds(evaluator, names))
    for k, bound in clouds:
        bound.reach(_components(evaluator, thetas, k), same_surfaces=on_the_way)
    return bool(clouds)


@contextmanager
def reached(evaluator: Evaluator, thetas: Floats) -> Iterator[None]:
    """Let clouds of a model that was never calibrated reach the populations at thetas, inside.

    They know the prior alone, and are thin around what was found by another process.
    """
    bounds = evaluator.reweighted.items()
    names = {name for name, bound in bounds if len(bound.design.groups) == 1}
    with _reaching(evaluator, thetas, names, on_the_way=False):
        yield


@contextmanager
def visited(evaluator: Evaluator, thetas: Floats) -> Iterator[None]:
    """Let clouds reach the populations at thetas, inside, with the emulators that they have."""
    with _reaching(evaluator, thetas, set(evaluator.reweighted), on_the_way=True):
        yield


@contextmanager
def _reaching(
    evaluator: Evaluator, thetas: Floats, names: set[str], *, on_the_way: bool
) -> Iterator[None]:
    """Let clouds of the designs named reach populations, and bring them back afterwards."""
    with designs_restored([bound for _, bound in _clouds(evaluator, names)]):
        _reach(evaluator, thetas, names, on_the_way=on_the_way)
        yield


def _widened(
    evaluator: Evaluator, thetas: Floats, names: set[str], *, on_the_way: bool = False
) -> bool:
    """Draw larger clouds for the populations at thetas; return whether any could be."""
    grown = False
    for k, bound in _clouds(evaluator, names):
        grown |= bound.widen(_components(evaluator, thetas, k), same_surfaces=on_the_way)
    return grown


def _has_room(bound: ReweightedBound) -> bool:
    """Return whether runs are added to a design on the way: a cloud needs none."""
    return not bound.design.is_emulated and len(bound.design.batch_sizes) <= MAX_ROUNDS


def _thin(evaluator: Evaluator, thetas: Floats) -> set[str]:
    """Return the designs that reach fewer than half of the populations at thetas."""
    names = set()
    for name, support in evaluator.support(thetas).items():
        if np.median(support["weight_ess"]) < evaluator.reweighted[name].required_ess:
            names.add(name)
    return names


def noise_floors(evaluator: Evaluator, theta: Floats, n_sets: int) -> Floats:
    """Return the mean discrepancy of data sets drawn from the model at theta, (k,) by simulator."""
    floors = []
    for k in range(len(evaluator.nodes)):
        information = Information(evaluator, k, theta, n_sets=n_sets)
        floors.append(information.noise_floor)
    return np.array(floors)


def refuse(
    short: Mapping[str, Shortcoming], evaluator: Evaluator, findings: Iterable[Finding] = ()
) -> None:
    """Raise for designs that still fall short, with what else is known of where they do."""
    if not short:
        return
    what = "; ".join(
        f"{name}: the design does not support the answer: {s}" for name, s in short.items()
    )
    bound = evaluator.reweighted[next(iter(short))]
    known = "".join(f". {finding}" for finding in findings)
    raise DesignError(
        f"{what}; narrow the priors, pass a larger prb.Reweighted(n) (now {bound.n_runs} runs "
        f"in all, of at most {bound.config.most}), or use prb.Resimulated(n), which has no design"
        f"{known}"
    )


def refuse_lost(evaluator: Evaluator, lost: Mapping[str, float]) -> None:
    """Raise where too much of a population, of shares by simulator, has no response.

    Of designs, refinement says it.
    """
    for node in evaluator.nodes:
        share = lost.get(node.name, 0.0)
        most = node.bound.max_lost
        if node.reweighted is None and share > most:
            raise DesignError(
                f"{node.name}: lost mass: got {share:.1%} of the population without a response "
                f"(NaN) at the answer, expected at most max_lost = {most:.1%}: it would rest on "
                "the specimens that have one; repair the response, return +inf for specimens that "
                "fail, or pass a larger max_lost to the propagation"
            )


def spread_around(center: Floats, covariance: Floats, prior_sd: Floats, *, seed: int = 0) -> Floats:
    """Return thetas around an optimum, from a normal with its covariance, no wider than the prior.

    Along elements of which nothing is known they are as wide as the prior.
    """
    unit = np.outer(prior_sd, prior_sd)
    relative = np.where(np.isfinite(covariance), covariance / unit, 0.0)
    known = np.isfinite(np.diag(covariance))
    variances = np.where(known, np.diag(relative), 1.0)
    np.fill_diagonal(relative, variances)
    values, vectors = np.linalg.eigh(relative)
    sd = np.sqrt(np.clip(values, 0, 1))
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((THETAS, center.size))
    steps = (z * sd) @ oriented(vectors).T
    return np.asarray(center + steps * prior_sd)


def spread_along(center: Floats, local: Local, *, seed: int = 0) -> Floats:
    """Return thetas around an optimum along the directions that the data identify, (256, d)."""
    values, vectors = np.linalg.eigh(local.covariance)
    sd = np.sqrt(np.clip(values, 0, 1))
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((THETAS, sd.size))
    steps = (z * sd) @ oriented(local.identified @ vectors).T
    return np.asarray(center + steps * local.prior_sd)
