"""A unit for co-simulation, FMI 2: `pythonfmu build -f oscillator.py` makes it."""

import contextlib
import os
import time

from pythonfmu import (
    Boolean,
    DefaultExperiment,
    Fmi2Causality,
    Fmi2Slave,
    Fmi2Variability,
    Integer,
    Real,
    String,
)


class Oscillator(Fmi2Slave):
    """A force moves a damped mass; its work adds up from step to step."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.default_experiment = DefaultExperiment(start_time=1.0, stop_time=3.0, step_size=0.5)
        self.stiffness, self.force, self.gain, self.turns = 2.0, 1.0, 1.0, 1
        self.doubled, self.material = False, "steel"
        self.position, self.work, self.steps, self.heavy = 0.0, 0.0, 0, False
        parameter, output = Fmi2Causality.parameter, Fmi2Causality.output
        self.register_variable(
            Real("stiffness", causality=parameter, variability=Fmi2Variability.tunable)
        )
        self.register_variable(Real("gain", causality=parameter, variability=Fmi2Variability.fixed))
        self.register_variable(
            Integer("turns", causality=parameter, variability=Fmi2Variability.fixed)
        )
        self.register_variable(
            Boolean("doubled", causality=parameter, variability=Fmi2Variability.fixed)
        )
        self.register_variable(
            String("material", causality=parameter, variability=Fmi2Variability.fixed)
        )
        self.register_variable(Real("force", causality=Fmi2Causality.input))
        self.register_variable(Real("position", causality=output))
        self.register_variable(Real("work", causality=output))
        self.register_variable(
            Integer("steps", causality=output, variability=Fmi2Variability.discrete)
        )
        self.register_variable(
            Boolean("heavy", causality=output, variability=Fmi2Variability.discrete)
        )

    def do_step(self, begin, size):
        if self.force > 100:
            time.sleep(self.force / 1000)
        if self.stiffness == -7:
            os._exit(3)
        while self.stiffness == -9:
            # As what hangs outside Python, which no exception ends.
            with contextlib.suppress(BaseException):
                time.sleep(600)
        if self.stiffness < 0:
            raise ArithmeticError("no equilibrium")
        if self.stiffness == 0:
            return False
        factor = self.gain * self.turns * (1 + self.doubled) * (2 if self.material == "gold" else 1)
        self.position = factor * self.force / self.stiffness * (begin + size)
        self.work += self.force**2 * size
        self.steps += 1
        self.heavy = self.force > 50
        return True
