"""Several outputs by a metric of one: the mean over directions in whitened coordinates."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats, positive_integer
from prbayes.metrics.base import Discrepancy, Part
from prbayes.metrics.components import (
    FEWEST,
    LEFT_OUT,
    MOST_OUTPUTS,
    Components,
    principal_components,
)
from prbayes.metrics.multivariate import (
    CompositeDiscrepancy,
    LiftedMetric,
    directions,
    failure_caps,
    sufficient_directions,
)
from prbayes.metrics.views import Centered, Projection
from prbayes.metrics.whitening import Whitening, units, whitening


@dataclass(frozen=True)
class Joint(LiftedMetric):
    r"""Several outputs of a specimen: the mean of a metric of one output over directions.

    The outputs are whitened: robust location and scatter of the observed values, t distribution
    with one degree of freedom, and invariant coordinates. The metric compares projections of both
    sides on fixed, well-spread directions. It thus compares correlations and all other dependence,
    and is invariant under affine maps of the outputs, such as changes of units. The minimiser has
    the robustness of the metric.

    With the energy distance as metric, :math:`2 \int (F - S_N)^2`, the mean over all directions is
    a multiple of the energy distance of several outputs [1]_; with the area metric it is the sliced
    Wasserstein distance [2]_.

    Parameters
    ----------
    metric : Metric
        Of one output.
    directions : int, optional
        Their number, (m - 1) (m + 2) for m outputs by default: errors of estimated means, standard
        deviations and correlations are then those of ten times as many, to 3%
        (``benchmarks/directions.py``). Fewer than m (m + 1) / 2 miss some correlations.
    components : int, optional
        More than eight outputs, such as curves, are replaced by their scores on principal
        components of data and design together: the fewest that leave out a hundredth of the
        variance of either. With a number this holds for fewer outputs as well. All outputs must
        have one unit.
    random_seed : int
        Of the directions of three or more outputs.

    Notes
    -----
    Outputs of fewer inputs are on a surface, or a curve. Only as many coordinates are compared as
    it has dimensions, if these leave out less than a hundredth of the outputs' variance, each in
    units of its spread; whitening would give the bend of the surface the same weight as the rest.

    A specimen that failed (+inf) counts as the largest observed value of that output plus the
    range. Where outputs are missing (NaN), each set of outputs that specimens have is compared with
    all specimens that have them, with the share of the specimens that have no others. More than
    eight sets, and sets of few specimens, are replaced by their intersections with others.

    Symmetric data have several frames of invariant coordinates, among which rounding decides.

    References
    ----------
    .. [1] Baringhaus, L. and C. Franz (2004), On a new multivariate two-sample test, J.
       Multivariate Anal. 88, 190-206, doi:10.1016/S0047-259X(03)00079-4.
    .. [2] Bonneel, N., J. Rabin, G. Peyré and H. Pfister (2015), Sliced and Radon Wasserstein
       barycenters of measures, J. Math. Imaging Vis. 51, 22-45, doi:10.1007/s10851-014-0506-3.

    Examples
    --------
    >>> import numpy as np
    >>> from prbayes import AreaMetric
    >>> x = np.random.default_rng(0).normal(size=(50, 2))
    >>> mirrored = np.stack([x[:, 0], -x[:, 1]], axis=-1)  # the same marginals
    >>> mixed = x @ [[1.0, 0.9], [0.0, 0.4]]
    >>> distance = Joint(AreaMetric()).against(mixed)
    >>> distance(mixed) < distance(mirrored @ [[1.0, 0.9], [0.0, 0.4]]) < distance(mixed * [1, -1])
    True
    """

    _: KW_ONLY
    directions: int | None = None
    components: int | None = None
    random_seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.directions is not None:
            positive_integer(self.directions, "directions")
        if self.components is not None:
            positive_integer(self.components, "components")
        positive_integer(self.random_seed, "random_seed", minimum=0)

    def with_design(self, target: Discrepancy, design: Floats, n_inputs: int) -> Discrepancy:
        """Return the discrepancy with principal components of data and design together.

        Inputs fewer than the outputs matter as well.
        """
        if target.observed.ndim < 2 or target.observed.shape[1] < 2:
            return target
        components = target.components if isinstance(target, CompositeDiscrepancy) else ()
        if not components and n_inputs >= target.observed.shape[1]:
            return target
        return self._prepare_outputs(target.observed, target.weights, design, n_inputs)

    def _prepare_outputs(
        self,
        observed: Floats,
        weights: Floats,
        design: Floats | None = None,
        n_inputs: int | None = None,
    ) -> Discrepancy:
        """Return the mean over directions, for each set of outputs that specimens have."""
        caps = failure_caps(observed)
        parts: list[Part] = []
        components: list[Components] = []
        for outputs, share in patterns(observed, weights):
            runs = None
            if design is not None:
                runs = design[:, outputs]
                runs = _capped(runs[~np.isnan(runs).any(axis=1)], caps[outputs])
            sample = observed[:, outputs]
            white, principal = self._white(sample, weights, outputs, caps[outputs], runs, n_inputs)
            components += principal
            centered = Centered(outputs, caps[outputs], white.center)
            m = white.axes.shape[1]
            number = 1 if m == 1 else self.directions or sufficient_directions(m)
            which = ""
            if outputs.size < observed.shape[1]:
                which = f" of outputs {', '.join(map(str, outputs.tolist()))}"
            for k, direction in enumerate(directions(m, number, self.random_seed)):
                view = Projection(centered, white.axes @ direction)
                values, index = view.observed_of(observed)
                target = self.metric.against(values, weights[index])
                parts.append(Part(target, share / number, f"direction {k + 1}{which}", view))
        targets = self.metric.on_one_scale([part.target for part in parts])
        parts = [replace(p, target=target) for p, target in zip(parts, targets, strict=True)]
        return CompositeDiscrepancy.of_parts(self, observed, weights, parts, tuple(components))

    def _white(
        self,
        sample: Floats,
        weights: Floats,
        outputs: NDArray[np.intp],
        caps: Floats,
        design: Floats | None,
        n_inputs: int | None,
    ) -> tuple[Whitening, list[Components]]:
        """Return white coordinates of some outputs, or of their principal components."""
        uses_components = outputs.size > MOST_OUTPUTS or self.components is not None
        if outputs.size < 2 or not uses_components:
            is_finite = np.isfinite(sample).all(axis=-1)
            sample, weights = sample[is_finite], weights[is_finite]
            white = whitening(sample, weights, outputs)
            if n_inputs is not None and n_inputs < outputs.size:
                white = _flat(sample, weights, outputs, n_inputs) or white
            return white, []
        is_complete = ~np.isnan(sample).any(axis=-1)
        sample, weights = _capped(sample[is_complete], caps), weights[is_complete]
        weights = weights / weights.sum()
        principal = principal_components(sample, weights, self.components, design)
        return _whitened_scores(principal, sample, weights), [principal]


def _whitened_scores(principal: Components, sample: Floats, weights: Floats) -> Whitening:
    """Return white coordinates of the scores on principal components."""
    scores = (sample - principal.center) @ principal.axes
    white = whitening(scores, weights, np.arange(principal.number))
    center = principal.center + principal.axes @ white.center
    return Whitening(center, principal.axes @ white.axes)


def _flat(
    sample: Floats, weights: Floats, outputs: NDArray[np.intp], n_inputs: int
) -> Whitening | None:
    """Return white coordinates of a surface that outputs of fewer inputs lie on; None if too bent.

    Whitening weights the bend of a surface as much as the places of specimens on it, which say more
    about the population.
    """
    weights = weights / weights.sum()
    center, unit = units(sample, weights, outputs)
    standard = (sample - center) / unit
    for number in range(max(1, n_inputs), outputs.size):
        principal = principal_components(standard, weights, number)
        if principal.left_out <= LEFT_OUT:
            white = _whitened_scores(principal, standard, weights)
            return Whitening(center + unit * white.center, white.axes / unit[:, None])
    return None


def _capped(outputs: Floats, caps: Floats) -> Floats:
    """Return outputs (n, m) with a failure as the cap."""
    return np.where(np.isposinf(outputs), caps, outputs)


def patterns(observed: Floats, weights: Floats) -> list[tuple[NDArray[np.intp], float]]:
    """Return the sets of outputs that are compared, and the share of each, (N, m), (N,).

    They are those of the specimens, or their intersections where there are too many sets, or too
    few specimens with a set.
    """
    counted = weights > 0
    has = ~np.isnan(observed[counted])
    shares: dict[frozenset[int], float] = {}
    for row, weight in zip(has, weights[counted], strict=True):
        key = frozenset(np.flatnonzero(row).tolist())
        shares[key] = shares.get(key, 0.0) + float(weight)
    while len(shares) > 1:
        rare = [key for key in shares if len(key) > 1 and _is_rare(key, has)]
        if rare:
            _divide(shares, min(rare, key=_order))
        elif len(shares) <= 8 or not _merge(shares):  # each set has its own directions
            break
    return [(np.array(sorted(key)), shares[key]) for key in sorted(shares, key=_order)]


def _order(key: frozenset[int]) -> tuple[int, list[int]]:
    """Return a key that sorts sets of outputs: the largest first."""
    return -len(key), sorted(key)


def _is_rare(key: frozenset[int], has: NDArray[np.bool_]) -> bool:
    """Return whether too few specimens have these outputs to whiten them, or their components."""
    needed = len(key) + 2 if len(key) <= MOST_OUTPUTS else FEWEST
    return int(has[:, list(key)].all(axis=-1).sum()) < needed


def _divide(shares: dict[frozenset[int], float], rare: frozenset[int]) -> None:
    """Move the share of a set to its largest intersection with another, or to its members."""
    share = shares.pop(rare)
    common = [rare & key for key in shares if rare & key and rare & key != rare]
    heirs = [frozenset([output]) for output in rare]
    if common:
        most = max(map(len, common))
        heirs = [min((key for key in common if len(key) == most), key=_order)]
    for heir in heirs:
        shares[heir] = shares.get(heir, 0.0) + share / len(heirs)


def _merge(shares: dict[frozenset[int], float]) -> bool:
    """Replace the rarest set and its nearest by their intersection; return whether there is one."""
    rarest = min(shares, key=lambda key: (shares[key], _order(key)))
    candidates = sorted((key for key in shares if key != rarest), key=_order)
    nearest = max(candidates, key=lambda key: (len(key & rarest), shares[key]))
    common = nearest & rarest
    if not common:
        return False
    share = shares.pop(rarest) + shares.pop(nearest)
    shares[common] = shares.get(common, 0.0) + share
    return True
