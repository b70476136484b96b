"""Measured data that ship with the package."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import xarray as xr

__all__ = ["crack_growth", "theophylline", "virkler"]


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
    return _dataset(
        "crack_growth.csv",
        "crack_length_inch",
        {"long_name": "crack length", "units": "inch"},
        "million_cycles",
        {"units": "million cycles"},
        description=(
            "Fatigue crack growth in metal: crack length of 21 specimens, read every 10 000 cycles "
            "to 0.01 inch, until 1.60 inch (failure) or 120 000 cycles; NaN after failure"
        ),
        source=(
            "C. J. Lu and W. Q. Meeker (1993), Using degradation measures to estimate a "
            "time-to-failure distribution, Technometrics 35(2), 161-174, Table 1; values read from "
            "figure 4.5.2 of J. L. Bogdanoff and F. Kozin (1985), Probabilistic Models of "
            "Cumulative Damage, Wiley"
        ),
        notch_inch=0.90,
    )


def theophylline() -> xr.Dataset:
    """Return concentrations of theophylline in the blood of 12 subjects after an oral dose.

    Each subject had a dose and times of samples of their own.

    Returns
    -------
    xarray.Dataset
        ``concentration_mg_per_l`` and ``time_h`` with dims ``(specimen, sample)``, shape (12, 11),
        in mg/l and hours; ``dose_mg`` and ``weight_kg`` with the dim ``specimen``, in mg and kg.
        ``specimen`` counts from 1. Every call returns a new object.

    References
    ----------
    .. [1] A. J. Boeckmann, L. B. Sheiner and S. L. Beal (1994), NONMEM Users Guide: Part V, NONMEM
       Project Group, University of California, San Francisco; from the data set Theoph of R.

    Examples
    --------
    >>> from prbayes import datasets
    >>> drug = datasets.theophylline()
    >>> round(float(drug.concentration_mg_per_l.max()), 1), round(float(drug.dose_mg.mean()))
    (11.4, 315)
    """
    with files(__package__).joinpath("theophylline.csv").open(encoding="utf-8") as file:
        table = np.loadtxt(file, delimiter=",", skiprows=1)
    subject, weight, dose, time, concentration = table.reshape(12, 11, 5).transpose(2, 0, 1)
    dims = ("specimen", "sample")
    return xr.Dataset(
        {
            "concentration_mg_per_l": (dims, concentration, {"units": "mg/l"}),
            "time_h": (dims, time, {"units": "h"}),
            "dose_mg": ("specimen", dose[:, 0] * weight[:, 0], {"units": "mg"}),
            "weight_kg": ("specimen", weight[:, 0], {"units": "kg"}),
        },
        coords={"specimen": subject[:, 0].astype(int)},
        attrs={
            "description": (
                "Concentration of theophylline in serum after an oral dose: 12 subjects, each "
                "with 11 times of their own, up to 25 hours"
            ),
            "source": (
                "A. J. Boeckmann, L. B. Sheiner and S. L. Beal (1994), NONMEM Users Guide: Part V, "
                "NONMEM Project Group, University of California, San Francisco; data set Theoph of "
                "R"
            ),
        },
    )


def virkler() -> xr.Dataset:
    """Return the fatigue crack lengths of 68 aluminium specimens, the Virkler data, digitised.

    Centre-cracked panels of 2024-T3 aluminium, with a half crack length of 9 mm at the beginning,
    under one and the same load. The half length is given every 20 000 cycles.

    Returns
    -------
    xarray.Dataset
        ``half_crack_length_mm`` with dims ``(specimen, kilocycles)``, shape (68, 12), in mm; NaN
        where a crack had grown beyond the record, which ends at 36.6 mm. ``specimen`` counts from
        1, ``kilocycles`` runs from 20 to 240. Every call returns a new object.

    Notes
    -----
    The values were read from a figure, and its author notes that paths do not cross here, where in
    the original some do: a specimen whose crack is longer early is so ever after.

    References
    ----------
    .. [1] D. A. Virkler, B. M. Hillberry and P. K. Goel (1979), The statistical nature of fatigue
       crack propagation, J. Eng. Mater. Technol. 101, 148-153, doi:10.1115/1.3443666.
    .. [2] J. L. Bogdanoff and F. Kozin (1985), Probabilistic Models of Cumulative Damage, Wiley,
       figure 4.5.3, from which W. Richards read the values (CC0).

    Examples
    --------
    >>> from prbayes import datasets
    >>> lengths = datasets.virkler().half_crack_length_mm.sel(kilocycles=200)
    >>> round(float(lengths.mean()), 2), round(float(lengths.std(ddof=1)), 2)
    (27.61, 3.01)
    """
    return _dataset(
        "virkler.csv",
        "half_crack_length_mm",
        {"long_name": "half crack length", "units": "mm"},
        "kilocycles",
        {"units": "1000 cycles"},
        description=(
            "Fatigue crack growth in 2024-T3 aluminium: half crack length of 68 specimens every "
            "20 000 cycles, from 9 mm at the beginning; NaN beyond 36.6 mm"
        ),
        source=(
            "D. A. Virkler, B. M. Hillberry and P. K. Goel (1979), The statistical nature of "
            "fatigue crack propagation, J. Eng. Mater. Technol. 101, 148-153; read by W. Richards "
            "(CC0) from figure 4.5.3 of J. L. Bogdanoff and F. Kozin (1985), Probabilistic Models "
            "of Cumulative Damage, Wiley"
        ),
        start_mm=9.0,
        end_mm=36.6,
    )


def _dataset(
    file_name: str,
    variable: str,
    units: dict[str, str],
    dim: str,
    dim_units: dict[str, str],
    **attrs: object,
) -> xr.Dataset:
    """Return a file with a specimen, an abscissa and a value in each line; NaN without a line."""
    with files(__package__).joinpath(file_name).open(encoding="utf-8") as file:
        specimens, abscissas, values = np.loadtxt(file, delimiter=",", skiprows=1, unpack=True)
    specimen, row = np.unique(specimens.astype(int), return_inverse=True)
    abscissa, column = np.unique(abscissas, return_inverse=True)
    table = np.full((specimen.size, abscissa.size), np.nan)
    table[row, column] = values
    return xr.Dataset(
        {variable: (("specimen", dim), table, units)},
        coords={"specimen": specimen, dim: (dim, abscissa, dim_units)},
        attrs=attrs,
    )
