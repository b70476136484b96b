"""Draws of inputs from their prior predictive distribution."""

from __future__ import annotations

from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import PopulationSampler, prior_draws, valid
from prbayes.response.inputs import Inputs, model_on_context, read_inputs

# Ranges are quantiles of these 2^15 draws: with the default coverage of .999 some 16 draws lie
# beyond either end, and the share left out is known to a quarter. That most draws are populations
# and not specimens of one is by judgement: specimens of one population are alike, but a population
# costs more to draw.
POPULATIONS, SPECIMENS = 512, 64


def predictive_inputs(name: str, variables: list[Any], random_seed: int) -> list[Floats]:
    """Return prior predictive draws of variables, shapes (populations, specimens, *event).

    Parameters
    ----------
    name : str
        For messages.
    variables : list of variable
        ``.dist()`` objects and variables of the model on the context.
    random_seed : int

    Raises
    ------
    TypeError
        If there is no model on the context.
    ValueError
        If the parameters of the inputs are invalid at all draws of the priors.
    """
    model = model_on_context(None, f"{name}: inputs that are distributions")
    inputs = read_inputs(name, variables, model)
    roots = prior_draws(inputs.roots, POPULATIONS, random_seed)
    usable = _usable(inputs, roots)
    if not usable.size:
        raise ValueError(
            f"{name}: got invalid parameters of the inputs at all draws of the priors, "
            "expected valid ones"
        )
    # Draws with invalid parameters, such as a negative standard deviation, give way to others.
    chosen = usable[np.arange(POPULATIONS) % usable.size]
    valid_roots = [values[chosen] for values in roots]
    rng = np.random.default_rng(random_seed)
    aleatory, epistemic = PopulationSampler(inputs)(valid_roots, SPECIMENS, rng)
    draws = []
    for values in inputs.fill(aleatory, epistemic):
        event = values.shape[2:]
        # An epistemic value is one for all specimens.
        full = np.broadcast_to(values, (POPULATIONS, SPECIMENS, *event))
        draws.append(full.astype(np.float64))
    return draws


def _usable(inputs: Inputs, roots: list[Floats]) -> Any:
    """Return the numbers of the draws of the priors at which the inputs' parameters are valid."""
    symbols = inputs.placeholders()
    aleatory, _ = inputs.rebuilt(symbols)
    function = compile_batched(symbols, [valid(inputs, aleatory)])
    (ok,) = function(*roots)
    return np.flatnonzero(np.broadcast_to(ok, POPULATIONS))
