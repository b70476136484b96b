"""A model with a data sheet in the place of specimens, on the emulator of other specimens."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.model.fgraph import clone_model

from prbayes._validate import Floats
from prbayes.metrics.summary import Summary
from prbayes.metrics.summary_likelihood import SummaryLikelihood
from prbayes.model.emulated import EmulatedSimulator
from prbayes.model.random_variable import (
    SimulatorDistribution,
    SimulatorRV,
    Specification,
    response_name,
    rv_signature,
    shared_epsilon,
)
from prbayes.propagation.reweighted import Reweighted
from prbayes.response.response import Responses


class EmulatedFunction:
    """The response of a simulator by its emulator, as a function of all of its inputs."""

    def __init__(self, simulator: EmulatedSimulator) -> None:
        self.simulator = simulator
        self.__name__ = response_name(simulator.responses.function)

    def __call__(self, *values: Any) -> Floats:
        """Return responses, (...), of inputs, (..., *event)."""
        inputs = self.simulator.inputs
        places = [[x is source for source in inputs.sources].index(True) for x in inputs.aleatory]
        arrays = [np.asarray(values[place], dtype=np.float64) for place in places]
        batch = arrays[0].shape[: arrays[0].ndim - len(inputs.event_shapes[0])]
        pairs = zip(arrays, inputs.event_shapes, strict=True)
        return self.simulator.emulated([x.reshape(-1, *s) for x, s in pairs]).reshape(batch)


def model_with_sheet(model: pm.Model, simulator: EmulatedSimulator, sheet: Summary) -> pm.Model:
    """Return a copy of a model that compares its simulator with a data sheet.

    The runs of the copy are values of the emulator, which may be that of another copy.
    """
    copy = clone_model(model)
    name = simulator.name
    application = copy[name].owner
    params = application.op.dist_params(application)
    _remove_observed(copy, name)
    responses = Responses(
        name,
        EmulatedFunction(simulator),
        simulator.inputs,
        outputs=simulator.outputs,
        scatter=None,
    )
    target = SummaryLikelihood(sheet).against(sheet.values)
    epsilon = shared_epsilon(name, 1 / sheet.n)
    specification = Specification(
        name,
        target,
        responses,
        Reweighted(),
        epsilon,
        None,
        outputs=simulator.outputs,
        progressbar=False,
    )
    operation = SimulatorRV(
        signature=rv_signature([p.type.ndim for p in params], 0),
        reference=weakref.ref(specification),
        simulators=(name,),
    )
    with copy:
        observed = pt.constant(sheet.values)
        rv = SimulatorDistribution(name, *params, operation=operation, observed=observed)
    rv.owner.op.owner = weakref.ref(rv.owner)
    return copy


def _remove_observed(model: pm.Model, name: str) -> None:
    """Remove an observed variable from a model."""
    variable = model[name]
    model.observed_RVs.remove(variable)
    del model.values_to_rvs[model.rvs_to_values.pop(variable)]
    model.rvs_to_transforms.pop(variable, None)
    model.rvs_to_initial_values.pop(variable, None)
    model.named_vars.pop(name)
    model.named_vars_to_dims.pop(name, None)
