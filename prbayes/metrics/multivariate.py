"""A metric of several outputs: the mean of a metric of one number over projections."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from prbayes._validate import (
    AT_ONCE,
    Bools,
    Floats,
    Indices,
    Names,
    finite_or_nan,
    positive_integer,
    real_array,
    sample_weights,
    wrong_value,
)
from prbayes.metrics.base import (
    Basis,
    Discrepancy,
    Features,
    Metric,
    Part,
    PartSum,
    Projection,
    StoredBasis,
)
from prbayes.metrics.whitening import (
    LEFT_OUT,
    MOST_OUTPUTS,
    Components,
    principal_components,
    units,
    whitening,
)

type _Coordinates = tuple[Floats, Floats]  # center and axes; see `whitening`


@dataclass(frozen=True, eq=False)
class CompositeDiscrepancy(Discrepancy):
    """A sum of discrepancies of projections against fixed observed values of several outputs."""

    members: tuple[Part, ...]
    # Shares of the components, (K,) or (..., K). They differ between data sets, since a data set
    # may have no specimen of a component.
    shares: Floats
    # Principal components of each set of outputs that is compared by them.
    components: tuple[Components, ...] = ()
    _by_data_set: ClassVar[Names] = ("weights", "shares")

    @property
    def parts(self) -> tuple[Part, ...]:
        """The components of the sum."""
        return self.members

    @property
    def scale(self) -> float:
        """The sum of the typical sizes of the components."""
        return float(sum(part.share * part.target.scale for part in self.members))

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells and projections, against other values (n, m).

        A component sees the rows that have its outputs. If none of these has weight in a data set,
        the other components take its share there.
        """
        w = sample_weights(weights, len(observed))
        batch = w.shape[:-1]
        parts = []
        has_specimens = np.zeros((*batch, len(self.members)), dtype=bool)
        for k, part in enumerate(self.members):
            values, index = part.observed_of(observed)
            part_weights = w[..., index]
            has_specimens[..., k] = part_weights.sum(axis=-1) > 0
            if not index.size:  # no specimen has values: use any values, with weight zero
                values = part.target.observed
                part_weights = np.zeros((*batch, len(values)))
            part_weights = np.where(has_specimens[..., k, None], part_weights, 1.0)
            parts.append(replace(part, target=part.target.with_observed(values, part_weights)))
        if not has_specimens.any(axis=-1).all():
            raise ValueError(
                "observed: got a sample without specimens that have all outputs of a component, "
                f"expected some with those of {self.members[0].label!r} or of another component; "
                "prepare the metric for this sample with Metric.against"
            )
        nominal = np.array([part.share for part in parts])
        if has_specimens.all():
            shares = np.broadcast_to(nominal, has_specimens.shape)
        else:
            shares = nominal * has_specimens
            shares = shares * (nominal.sum() / shares.sum(axis=-1, keepdims=True))
        return replace(self, observed=observed, weights=w, members=tuple(parts), shares=shares)

    def rows(self, index: Any) -> Self:
        """Return some of several data sets."""
        parts = tuple(replace(p, target=p.target.rows(index)) for p in self.members)
        return replace(super().rows(index), members=parts)

    @cached_property
    def _sum(self) -> PartSum:
        """The components, evaluated together."""
        return self.members[0].target.together(self.members)

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the features of the components."""
        return self._sum.features(simulated, weights, xp)

    def basis(self, simulated: Floats, most: float = AT_ONCE) -> Basis:
        """Return the map from weights of stored values, (n, m), to features."""
        if not self.metric.symbolic:
            return StoredBasis((simulated,), self)
        return self._sum.basis(simulated, most)

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the sum of the components, each times its share."""
        return self._sum.outer(features, self.shares, xp)


def components_of(target: Discrepancy) -> tuple[Components, ...]:
    """Return the principal components that outputs are compared by."""
    return target.components if isinstance(target, CompositeDiscrepancy) else ()


def failure_caps(observed: Floats) -> Floats:
    """Return the value of a failure in each output: the largest observed one plus the range."""
    finite = finite_or_nan(observed)
    highest = np.nanmax(finite, axis=0)
    lowest = np.nanmin(finite, axis=0)
    return np.asarray(highest + (highest - lowest))


def sufficient_directions(m: int) -> int:
    """Return a sufficient number of directions for m outputs, at least two.

    Twice as many as a scatter's shape has parameters.
    """
    return (m - 1) * (m + 2)


@cache
def directions(m: int, number: int, seed: int) -> Floats:
    """Return well-spread unit vectors, shape (number, m), the same for the same arguments.

    In the plane they are at equal angles. In more dimensions they start at random, and each vector
    repels the others and their opposites.
    """
    if m == 1:
        return np.ones((number, 1))
    if m == 2:
        angles = np.pi * (np.arange(number) + 0.5) / number
        return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return repelled(np.random.default_rng(seed).standard_normal((number, m)))


def repelled(u: Floats, steps: int = 2000) -> Floats:
    """Return unit vectors at a low energy, the sum of -log(1 - cosine^2) over their pairs.

    With twice as many steps the largest cosine is the same to .03 (test).
    """

    def normalized(vectors: Floats) -> Floats:
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    u = normalized(u)
    number, m = u.shape
    # Steps are a fraction of the distance between neighbours, since longer ones amplify rounding.
    longest = 0.2 * number ** (-1 / (m - 1))
    for step in range(steps):
        cosine = u @ u.T
        np.fill_diagonal(cosine, 0.0)
        # The constant bounds the force between two vectors that start close together.
        force = (cosine / (1 - cosine**2 + 1e-3)) @ u
        force -= (force * u).sum(axis=-1, keepdims=True) * u
        largest = np.linalg.norm(force, axis=-1).max()
        if largest == 0:
            break
        move = longest * (1 - step / steps) / max(largest, 1.0)
        u = normalized(u - move * force)
    return u


# Attributes that a `Joint` metric takes over from its metric of one output.
_DECLARED = "minimum", "additive", "symbolic", "takes_weights", "tail_responses", "distance"


@dataclass(frozen=True)
class Joint(Metric):
    r"""Several outputs of a specimen: the mean of a metric of one output over directions.

    The outputs are whitened: robust location and scatter of the observed values, t distribution
    with one degree of freedom, and invariant coordinates. The metric compares projections of both
    sides on fixed, well-spread directions. It thus compares correlations and all other dependence,
    and is invariant under affine maps of the outputs, such as changes of units. The minimiser has
    the robustness of the metric. Coordinates depend on the observed values alone.

    With the energy distance as metric, :math:`2 \int (F - S_N)^2`, the mean over all directions is
    a multiple of the energy distance of several outputs [1]_. With the area metric it is the sliced
    Wasserstein distance [2]_.

    Parameters
    ----------
    metric : Metric
        Of one output.
    directions : int, optional
        Their number, (m - 1) (m + 2) for m outputs by default, twice as many as a scatter's shape
        has parameters. Fewer than m (m + 1) / 2 miss some correlations.
    components : int, optional
        More than eight outputs, such as curves, are replaced by their scores on principal
        components of the data: the fewest that leave out a hundredth of the variance, at most
        eight, or one for five specimens. With a number this holds for fewer outputs as well. All
        outputs must have one unit.
    random_seed : int
        Of the directions of three or more outputs.

    Raises
    ------
    TypeError, ValueError
        If the metric is not one of a single output, or another argument is not as described.

    Notes
    -----
    Outputs of fewer inputs are on a surface, or a curve. Only as many coordinates are compared as
    it has dimensions, each in units of its spread, if these leave out less than a hundredth of the
    outputs' variance. Whitening would give the bend of the surface the same weight as the rest.

    Few specimens, below 5 m and 3 m (m + 1) / 2, determine ratios of variances badly. These are
    shrunk, in units of the outputs' spreads, so that the metric is invariant under changes of units
    but not under all affine maps.

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

    metric: Metric
    _: KW_ONLY
    directions: int | None = None
    components: int | None = None
    random_seed: int = 0
    counts_failures: ClassVar[bool] = True
    takes_outputs: ClassVar[bool] = True
    additive = False

    def __post_init__(self) -> None:
        if not isinstance(self.metric, Metric) or self.metric.takes_outputs:
            raise wrong_value(
                self.metric, "metric", "a metric of one output, such as prb.ProbabilityResidual()"
            )
        for name in _DECLARED:
            object.__setattr__(self, name, getattr(self.metric, name))
        if self.directions is not None:
            positive_integer(self.directions, "directions")
        if self.components is not None:
            positive_integer(self.components, "components")
        positive_integer(self.random_seed, "random_seed", minimum=0)

    def like(self, metric: Metric) -> Metric:
        """Return the same comparison of outputs by another metric of one."""
        return replace(self, metric=metric)

    def against(self, observed: ArrayLike, weights: ArrayLike | None = None) -> Discrepancy:
        """Prepare the observed side.

        Parameters
        ----------
        observed : array_like, shape (N, m)
            Measured responses, a row for each specimen. NaN, or a mask, is an output that was not
            measured, +inf a specimen that failed. The metric of one output takes shape (N,).
        weights : array_like, shape (N,), optional
            Weights of the specimens; equal by default.

        Raises
        ------
        TypeError, ValueError
            If the observed values are not real, if a specimen has no output, an output no specimen,
            or too few for a comparison.
        """
        if real_array(observed, "observed").ndim < 2:
            return self.metric.against(observed, weights)
        return super().against(observed, weights)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if observed.shape[1] > 1:
            return self._prepare_outputs(observed, weights)
        target = self.metric.against(observed[:, 0], weights)
        view = Projection(np.array([0]), np.array([np.inf]), np.zeros(1), np.ones(1))
        parts = (Part(target, 1.0, "output", view),)
        return CompositeDiscrepancy(self, observed, weights, parts, np.ones(1))

    def for_inputs(self, target: Discrepancy, n_inputs: int) -> Discrepancy:
        """Return the discrepancy of outputs of fewer inputs, which are on a surface."""
        if target.observed.ndim < 2 or n_inputs >= target.observed.shape[1]:
            return target
        return self._prepare_outputs(target.observed, target.weights, n_inputs)

    def _prepare_outputs(
        self, observed: Floats, weights: Floats, n_inputs: int | None = None
    ) -> Discrepancy:
        """Return the mean discrepancy over projections, for each set of measured outputs."""
        caps = failure_caps(observed)
        parts = []
        components = []
        for outputs, share in patterns(observed, weights):
            sample = observed[:, outputs]
            (center, axes), principal = self._white(
                sample, weights, outputs, caps[outputs], n_inputs
            )
            components += principal
            m = axes.shape[1]
            number = 1 if m == 1 else self.directions or sufficient_directions(m)
            which = ""
            if outputs.size < observed.shape[1]:
                which = f" of outputs {', '.join(map(str, outputs.tolist()))}"
            for k, direction in enumerate(directions(m, number, self.random_seed)):
                view = Projection(outputs, caps[outputs], center, axes @ direction)
                values, index = view.observed_of(observed)
                target = self.metric.against(values, weights[index])
                parts.append(Part(target, share / number, f"direction {k + 1}{which}", view))
        targets = self.metric.on_one_scale([part.target for part in parts])
        parts = [replace(p, target=target) for p, target in zip(parts, targets, strict=True)]
        shares = np.array([part.share for part in parts])
        return CompositeDiscrepancy(
            self, observed, weights, tuple(parts), shares, tuple(components)
        )

    def _white(
        self,
        sample: Floats,
        weights: Floats,
        outputs: Indices,
        caps: Floats,
        n_inputs: int | None,
    ) -> tuple[_Coordinates, list[Components]]:
        """Return white coordinates of some outputs, or of their principal components."""
        if outputs.size > 1 and (outputs.size > MOST_OUTPUTS or self.components is not None):
            is_complete = ~np.isnan(sample).any(axis=-1)
            sample = sample[is_complete]
            weights = weights[is_complete]
            sample = np.where(np.isposinf(sample), caps, sample)
            weights = weights / weights.sum()
            principal = principal_components(sample, weights, outputs, self.components)
            return _whitened_scores(principal, sample, weights), [principal]
        is_finite = np.isfinite(sample).all(axis=-1)
        sample = sample[is_finite]
        weights = weights[is_finite]
        white = whitening(sample, weights, outputs)
        if n_inputs is not None and n_inputs < outputs.size:
            white = _flat(sample, weights, outputs, n_inputs) or white
        return white, []


def _whitened_scores(principal: Components, sample: Floats, weights: Floats) -> _Coordinates:
    """Return white coordinates of the scores on principal components."""
    scores = (sample - principal.center) @ principal.axes
    center, axes = whitening(scores, weights, np.arange(principal.number))
    return principal.center + principal.axes @ center, principal.axes @ axes


def _flat(sample: Floats, weights: Floats, outputs: Indices, n_inputs: int) -> _Coordinates | None:
    """Return white coordinates of the surface on which outputs of fewer inputs lie.

    Whitening of all outputs would give the bend of the surface the same weight as the positions of
    specimens on it, which depend on the population more. None if the surface is too bent.
    """
    weights = weights / weights.sum()
    center, unit = units(sample, weights, outputs)
    standard = (sample - center) / unit
    for number in range(max(1, n_inputs), outputs.size):
        principal = principal_components(standard, weights, outputs, number)
        if principal.left_out <= LEFT_OUT:
            inner, axes = _whitened_scores(principal, standard, weights)
            return center + unit * inner, axes / unit[:, None]
    return None


def patterns(observed: Floats, weights: Floats) -> list[tuple[Indices, float]]:
    """Return the sets of outputs that are compared, and the share of each, (N, m), (N,).

    Specimens with the same measured outputs form a set. Sets are replaced by their intersections if
    there are too many of them, or too few specimens with the outputs of a set.
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
        elif len(shares) <= 8 or not _merge(shares):  # each set costs directions of its own
            break
    return [(np.array(sorted(key)), shares[key]) for key in sorted(shares, key=_order)]


def _order(key: frozenset[int]) -> tuple[int, list[int]]:
    """Return a key by which sets of outputs are sorted, the largest first."""
    return -len(key), sorted(key)


def _is_rare(key: frozenset[int], has: Bools) -> bool:
    """Return whether too few specimens have these outputs to whiten them, or their components.

    Two principal components need ten specimens, because scatters of fewer are uncertain.
    """
    needed = len(key) + 2 if len(key) <= MOST_OUTPUTS else 10
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
    """Replace the rarest set and the nearest one by their intersection; False if it is empty."""
    rarest = min(shares, key=lambda key: (shares[key], _order(key)))
    candidates = sorted((key for key in shares if key != rarest), key=_order)
    nearest = max(candidates, key=lambda key: (len(key & rarest), shares[key]))
    common = nearest & rarest
    if not common:
        return False
    share = shares.pop(rarest) + shares.pop(nearest)
    shares[common] = shares.get(common, 0.0) + share
    return True
