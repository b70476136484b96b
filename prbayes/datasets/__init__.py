"""Measured data that ship with the package."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import xarray as xr

__all__ = ["crack_growth"]


def crack_growth() -> xr.Dataset:
    """Return the fatigue crack lengths of 21 metal specimens.

    Each specimen started from a notch of 0.90 inch; the crack length was read every 10 000 load
    cycles, to 0.01 inch. A test ended with the first reading of 1.60 inch or more (failure) or at
    120 000 cycles.

    Returns
    -------
    xarray.Dataset
        ``crack_length_inch`` with dims ``(specimen, million_cycles)``, shape (21, 13), in inch; NaN
        after the reading at which a specimen failed and was removed. ``specimen`` counts from 1,
        ``million_cycles`` runs from 0 to 0.12. Every call returns a new object.

    Notes
    -----
    The readings of one specimen are dependent: 21 specimens are 21 independent observations, not
    262. Divide by ``attrs["notch_inch"]`` for the relative crack length.

    References
    ----------
    .. [1] C. J. Lu and W. Q. Meeker (1993), Using degradation measures to estimate a
       time-to-failure distribution, Technometrics 35(2), 161-174, Table 1.
    .. [2] J. L. Bogdanoff and F. Kozin (1985), Probabilistic Models of Cumulative Damage, Wiley,
       figure 4.5.2, from which [1]_ read the values.

    Examples
    --------
    >>> from prbayes import datasets
    >>> crack = datasets.crack_growth()
    >>> lengths = crack.crack_length_inch.sel(million_cycles=0.05)
    >>> lengths.sizes["specimen"], round(float(lengths.max()), 2)
    (21, 1.19)
    """
    with files(__package__).joinpath("crack_growth.csv").open(encoding="utf-8") as file:
        specimens, cycles, lengths = np.loadtxt(file, delimiter=",", skiprows=1, unpack=True)
    specimen, row = np.unique(specimens.astype(int), return_inverse=True)
    million_cycles, column = np.unique(cycles, return_inverse=True)
    table = np.full((specimen.size, million_cycles.size), np.nan)
    table[row, column] = lengths
    return xr.Dataset(
        {
            "crack_length_inch": (
                ("specimen", "million_cycles"),
                table,
                {"long_name": "crack length", "units": "inch"},
            )
        },
        coords={
            "specimen": specimen,
            "million_cycles": ("million_cycles", million_cycles, {"units": "million cycles"}),
        },
        attrs={
            "description": (
                "Fatigue crack growth in metal: crack length of 21 specimens, read every 10 000 "
                "cycles to 0.01 inch, until 1.60 inch (failure) or 120 000 cycles; NaN after "
                "failure"
            ),
            "source": (
                "C. J. Lu and W. Q. Meeker (1993), Using degradation measures to estimate a "
                "time-to-failure distribution, Technometrics 35(2), 161-174, Table 1; values read "
                "from figure 4.5.2 of J. L. Bogdanoff and F. Kozin (1985), Probabilistic Models of "
                "Cumulative Damage, Wiley"
            ),
            "notch_inch": 0.90,
        },
    )
