"""`u_values`: measured values by the probability transform of the predictive distribution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from numpy.typing import ArrayLike

from prbayes._validate import Floats, Seed
from prbayes.validation.conditions import Predicted, read_case


def u_values(
    observed: ArrayLike | Mapping[str, ArrayLike] | Sequence[ArrayLike],
    predicted: Predicted | Mapping[str, Predicted] | Sequence[Predicted],
    *,
    randomize: bool = False,
    random_seed: Seed = 0,
) -> Floats:
    r"""Return where measured responses stand in the pooled predictive distribution.

    This is the probability integral transform:

    .. math:: u_i = \tfrac{1}{2} \{ P(Y < y_i) + P(Y \le y_i) \}

    over all draws and samples of the prediction together. Several conditions pool their u-values.

    Parameters
    ----------
    observed : array_like, shape (n,); or a mapping or list of such, by condition
        +inf is a specimen that had failed.
    predicted : DataArray from `predict`, or ndarray of shape (..., S); or a mapping or list of such
        +inf counts as larger than every number; NaN are left out.
    randomize : bool
        Whether u is uniform between P(Y < y) and P(Y <= y), and not the middle: then u-values of
        ties, such as failed specimens or discrete responses, are uniform too if the model is right.
    random_seed : int, sequence of int, numpy.random.Generator or None
        Of that choice.

    Returns
    -------
    ndarray, shape (n,)
        In the order of ``observed``, one condition after the other.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Notes
    -----
    Measured values that are rounded have ties that predicted ones have not: round the predicted
    ones alike, as in ``u_values(observed, predicted.round(2))``.

    References
    ----------
    .. [1] Czado, C., T. Gneiting and L. Held (2009), Predictive model assessment for count data,
       Biometrics 65, 1254-1261, doi:10.1111/j.1541-0420.2009.01191.x.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> prb.validation.u_values([0.3, 1.5, 9.0], np.array([0.0, 1.0, 2.0, 3.0]))
    array([0.25, 0.5 , 1.  ])
    """
    case = read_case(observed, predicted, randomize=randomize, random_seed=random_seed)
    return case.u_values()
