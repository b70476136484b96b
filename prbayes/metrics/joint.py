"""Several outputs by a metric of one: the mean over directions in whitened coordinates."""

from __future__ import annotations

from collections.abc import Sequence
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
from prbayes.metrics.directions import directions, enough
from prbayes.metrics.lifted import LiftedMetric, failure_caps
from prbayes.metrics.multivariate import Centered, CompositeDiscrepancy, Projection
from prbayes.metrics.whitening import Whitening, units, whitening

# By judgement: sets of measured outputs that are compared by themselves, each with directions of
# its own.
_PATTERNS = 8


@dataclass(frozen=True)
class Joint(LiftedMetric):
    r"""Several outputs of a specimen: the mean of a metric of one output over directions.

    The outputs are whitened: robust location and scatter of the observed values, t distribution
    with one degree of freedom, and invariant coordinates. Both sides are projected on fixed
    directions that are well spread there, and the metric compares the projections. So correlations
    and all else that outputs have in common are seen, and nothing depends on the units of the
    outputs, or on any other affine map of them. The minimiser has the robustness of the metric.

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
        (``benchmarks/directions.py``). Below m (m + 1) / 2 they do not tell all correlations.
    components : int, optional
        More than eight outputs, such as curves, are replaced by their scores on principal
        components of data and design together: as many as leave out a hundredth of the variance of
        either. Fewer outputs are if a number is given. All are then to be in one unit.
    random_seed : int
        Of the directions; those of two outputs do without.

    Notes
    -----
    Outputs of fewer inputs lie on a surface, or a curve. Beside a simulator's inputs only as many
    coordinates are compared as it has dimensions, where these leave out less than a hundredth of
    the outputs' variance, each in units of its spread; what is left out is how it is bent, of which
    whitening would make as much as of all else. Nothing depends on the outputs' units still.

    A specimen that failed (+inf) counts as the largest observed value of that output, and the
    range of them beyond it. Where outputs are missing (NaN), specimens are taken together by the
    outputs that they have: each set of outputs is compared with all specimens that have them, with
    a share as large as that of the specimens that have no others. More than eight sets, and sets
    that few specimens have, are replaced by what they have in common with others.

    Data that are symmetric have several frames of invariant coordinates, among which rounding
    decides.

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
    >>> turned = np.stack([x[:, 0], -x[:, 1]], axis=-1)  # the same marginals, if x is symmetric
    >>> mixed = x @ [[1.0, 0.9], [0.0, 0.4]]
    >>> found = Joint(AreaMetric()).against(mixed)
    >>> found(mixed) < found(turned @ [[1.0, 0.9], [0.0, 0.4]]) < found(mixed * [1, -1])
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

    def beside(self, observed: Floats, weights: Floats, design: Floats, inputs: int) -> Discrepancy:
        """Return the discrepancy with principal components of a design, (k, m), as well."""
        return self._made(observed, weights, design, inputs)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if observed.shape[1] == 1:
            return super()._prepare(observed, weights)
        return self._made(observed, weights, None, None)

    def _parts(self, observed: Floats, weights: Floats) -> Sequence[Part]:
        return self._made(observed, weights, None, None).parts

    def _made(
        self, observed: Floats, weights: Floats, design: Floats | None, inputs: int | None
    ) -> Discrepancy:
        caps = failure_caps(observed)
        parts: list[Part] = []
        components: list[Components] = []
        for outputs, share in patterns(observed, weights):
            known = None
            if design is not None:
                known = _known(design[:, outputs], caps[outputs])
            slices, found = self._slices(observed, weights, outputs, caps, share, known, inputs)
            parts += slices
            components += found
        targets = self.metric.on_one_scale([part.target for part in parts])
        parts = [replace(p, target=target) for p, target in zip(parts, targets, strict=True)]
        return CompositeDiscrepancy.of_parts(self, observed, weights, parts, tuple(components))

    def _slices(
        self,
        observed: Floats,
        weights: Floats,
        outputs: NDArray[np.intp],
        caps: Floats,
        share: float,
        design: Floats | None,
        inputs: int | None,
    ) -> tuple[list[Part], list[Components]]:
        """Return the parts that compare some outputs, of all specimens that have them."""
        chosen = observed[:, outputs]
        white, found = self._white(chosen, weights, outputs, caps[outputs], design, inputs)
        centered = Centered(outputs, caps[outputs], white.center)
        m = white.axes.shape[1]
        number = 1 if m == 1 else self.directions or enough(m)
        of = ""
        if outputs.size < observed.shape[1]:
            listed = ", ".join(map(str, outputs.tolist()))
            of = f" of outputs {listed}"
        parts = []
        for k, direction in enumerate(directions(m, number, self.random_seed)):
            view = Projection(centered, white.axes @ direction)
            values, index = view.observed_of(observed)
            target = self.metric.against(values, weights[index])
            label = f"direction {k + 1}{of}"
            parts.append(Part(target, share / number, label, view))
        return parts, found

    def _white(
        self,
        chosen: Floats,
        weights: Floats,
        outputs: NDArray[np.intp],
        caps: Floats,
        design: Floats | None,
        inputs: int | None,
    ) -> tuple[Whitening, list[Components]]:
        """Return white coordinates of some outputs, or of their principal components."""
        many = outputs.size > MOST_OUTPUTS or self.components is not None
        if outputs.size < 2 or not many:
            finite = np.isfinite(chosen).all(axis=-1)
            sample = chosen[finite]
            own = weights[finite]
            white = whitening(sample, own, outputs)
            if inputs is not None and inputs < outputs.size:
                white = _flat(sample, own, outputs, inputs) or white
            return white, []
        has = ~np.isnan(chosen).any(axis=-1)
        sample = _capped(chosen[has], caps)
        own = weights[has]
        own = own / own.sum()
        found = principal_components(sample, own, self.components, design)
        scores = (sample - found.center) @ found.axes
        white = whitening(scores, own, np.arange(found.number))
        center = found.center + found.axes @ white.center
        axes = found.axes @ white.axes
        return Whitening(center, axes), [found]


def _flat(
    sample: Floats, weights: Floats, outputs: NDArray[np.intp], inputs: int
) -> Whitening | None:
    """Return white coordinates of a surface that outputs of fewer inputs lie on; None if too bent.

    Whitening makes as much of how a surface is bent as of where on it specimens are, which tells
    more of the population.
    """
    own = weights / weights.sum()
    center, unit = units(sample, own, outputs)
    standard = (sample - center) / unit
    for number in range(max(1, inputs), outputs.size):
        found = principal_components(standard, own, number)
        if found.left_out <= LEFT_OUT:
            scores = (standard - found.center) @ found.axes
            white = whitening(scores, own, np.arange(number))
            middle = found.center + found.axes @ white.center
            axes = found.axes @ white.axes
            return Whitening(center + unit * middle, axes / unit[:, None])
    return None


def _capped(outputs: Floats, caps: Floats) -> Floats:
    """Return outputs (n, m) with a failure as the cap."""
    return np.where(np.isposinf(outputs), caps, outputs)


def _known(design: Floats, caps: Floats) -> Floats:
    """Return the runs of a design that have outputs, failures as the cap."""
    return _capped(design[~np.isnan(design).any(axis=1)], caps)


def patterns(observed: Floats, weights: Floats) -> list[tuple[NDArray[np.intp], float]]:
    """Return the sets of outputs that are compared, and the share of each, (N, m), (N,).

    They are those that specimens have, or what these have in common where there are too many, or
    too few specimens that have them.
    """
    counted = weights > 0
    has = ~np.isnan(observed[counted])
    shares: dict[frozenset[int], float] = {}
    for row, weight in zip(has, weights[counted], strict=True):
        key = frozenset(np.flatnonzero(row).tolist())
        shares[key] = shares.get(key, 0.0) + float(weight)
    while len(shares) > 1:
        thin = [key for key in shares if len(key) > 1 and _is_thin(key, has)]
        if thin:
            _divide(shares, min(thin, key=_order))
        elif len(shares) <= _PATTERNS or not _merge(shares):
            break
    found = []
    for key in sorted(shares, key=_order):
        outputs = np.array(sorted(key))
        found.append((outputs, shares[key]))
    return found


def _order(key: frozenset[int]) -> tuple[int, list[int]]:
    """Return what sorts sets of outputs: the largest first."""
    return -len(key), sorted(key)


def _is_thin(key: frozenset[int], has: NDArray[np.bool_]) -> bool:
    """Return whether too few specimens have these outputs to whiten them, or their components."""
    needed = len(key) + 2 if len(key) <= MOST_OUTPUTS else FEWEST
    return int(has[:, list(key)].all(axis=-1).sum()) < needed


def _divide(shares: dict[frozenset[int], float], thin: frozenset[int]) -> None:
    """Give the share of a set to the largest that it has in common with another, or its members."""
    share = shares.pop(thin)
    common = []
    for other in shares:
        both = thin & other
        if both and both != thin:
            common.append(both)
    heirs = [frozenset([output]) for output in thin]
    if common:
        most = max(map(len, common))
        largest = [both for both in common if len(both) == most]
        heirs = [min(largest, key=_order)]
    for heir in heirs:
        shares[heir] = shares.get(heir, 0.0) + share / len(heirs)


def _merge(shares: dict[frozenset[int], float]) -> bool:
    """Merge the rarest set with that with which it has most in common; whether there is one."""
    rarest = min(shares, key=lambda key: (shares[key], _order(key)))
    others = [key for key in shares if key != rarest]
    others.sort(key=_order)
    nearest = max(others, key=lambda key: (len(key & rarest), shares[key]))
    common = nearest & rarest
    if not common:
        return False
    share = shares.pop(rarest) + shares.pop(nearest)
    shares[common] = shares.get(common, 0.0) + share
    return True
