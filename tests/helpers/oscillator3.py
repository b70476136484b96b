"""A unit for co-simulation, FMI 3: `pythonfmu3 build -f oscillator3.py` makes it."""

from pythonfmu3 import Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability, Int32


class Oscillator3(Fmi3Slave):
    """A force moves a spring; its work adds up from step to step."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.stiffness, self.force, self.turns, self.position, self.work = (
            0.0,
            2.0,
            1.0,
            1,
            0.0,
            0.0,
        )
        self.register_variable(
            Float64(
                "time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous
            )
        )
        self.register_variable(
            Float64(
                "stiffness",
                causality=Fmi3Causality.parameter,
                variability=Fmi3Variability.tunable,
                start=2.0,
            )
        )
        self.register_variable(
            Int32(
                "turns",
                causality=Fmi3Causality.parameter,
                variability=Fmi3Variability.tunable,
                start=1,
            )
        )
        self.register_variable(Float64("force", causality=Fmi3Causality.input, start=1.0))
        self.register_variable(Float64("position", causality=Fmi3Causality.output))
        self.register_variable(Float64("work", causality=Fmi3Causality.output))

    def do_step(self, begin, size):
        if self.stiffness < 0:
            raise ArithmeticError("no equilibrium")
        self.position = self.turns * self.force / self.stiffness * (begin + size)
        self.work += self.force**2 * size
        return True
