"""Second differences of functions whose Hessian is known."""

import numpy as np

from prbayes.numerics.stencils import second_differences


def test_a_parabola() -> None:
    exact = np.array([[3.0, 1.0, 0.5], [1.0, -2.0, 0.0], [0.5, 0.0, 1.0]])
    found = second_differences(
        lambda x: 0.5 * np.einsum("bsi,ij,bsj->s", x, exact, x) + x.sum(axis=(0, 2)), 3
    )
    np.testing.assert_allclose(found, exact, atol=1e-12)
