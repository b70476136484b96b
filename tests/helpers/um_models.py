"""A server of UM-Bridge models: `python um_models.py PORT` serves until it is killed."""

from __future__ import annotations

import sys
import time
from typing import Any

import umbridge


class Beam(umbridge.Model):
    """Two numbers in, two out; none of them can be taken for another."""

    def get_input_sizes(self, config: Any) -> list[int]:
        return [2]

    def get_output_sizes(self, config: Any) -> list[int]:
        return [2]

    def __call__(self, parameters: Any, config: Any) -> list[list[float]]:
        ((x, y),) = parameters
        time.sleep(config.get("seconds", 0.0))
        return [[config.get("scale", 1.0) * (x - 2 * y), x * x * y]]

    def supports_evaluate(self) -> bool:
        return True


class Vectors(Beam):
    """A number and three in; one number and two out."""

    def get_input_sizes(self, config: Any) -> list[int]:
        return [1, 3]

    def get_output_sizes(self, config: Any) -> list[int]:
        return [1, 2]

    def __call__(self, parameters: Any, config: Any) -> list[list[float]]:
        (a,), (x, y, z) = parameters
        return [[a], [x - y, 10 * z]]


class Moody(Beam):
    """Gives one number, none, or an error."""

    def get_input_sizes(self, config: Any) -> list[int]:
        return [1]

    get_output_sizes = get_input_sizes

    def __call__(self, parameters: Any, config: Any) -> list[list[float]]:
        ((x,),) = parameters
        if x == 5:
            raise ArithmeticError("no equilibrium")
        if x < 0:
            time.sleep(-x)
        return [[{6: float("nan"), 7: float("inf"), 8: -float("inf")}.get(x, 2 * x)]]


class Mute(Beam):
    """Cannot be evaluated."""

    def supports_evaluate(self) -> bool:
        return False


if __name__ == "__main__":
    models = [Beam("beam"), Vectors("vectors"), Moody("moody"), Mute("mute")]
    umbridge.serve_models(models, int(sys.argv[1]), max_workers=4)
