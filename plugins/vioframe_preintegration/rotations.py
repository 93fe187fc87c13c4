"""Products of many small rotations without a loop over them."""

import numpy as np

from vioframe.checks import Array
from vioframe.geometry import so3

# Below this the fewer calls of the doubling scan are worth its additional products.
_FEW = 64


def exp_and_right_jacobian(phi: Array) -> tuple[Array, Array]:
    """Exp(φ) and J_r(φ), both (N, 3, 3), of vectors (N, 3) in rad.

    The same closed forms as :mod:`vioframe.geometry.so3`, written so that the two share their terms: a
    window of ten samples is all call overhead.
    """
    squared = np.einsum("ni,ni->n", phi, phi)
    # Below this sin(x)/x is exactly one, and division by zero is kept away.
    angle = np.sqrt(np.maximum(squared, 1e-60))
    half = 0.5 * angle
    sine = np.sin(angle) / angle
    versine = 0.5 * (np.sin(half) / half) ** 2
    # (x − sin x)/x³ loses digits to cancellation below 0.1 rad, where four terms of its series are exact.
    series = 1 / 6 + squared * (-1 / 120 + squared * (1 / 5040 - squared / 362880))
    cubic = np.where(squared < 0.01, series, (1.0 - sine) / np.maximum(squared, 0.01))
    skew = so3.hat(phi)
    outer = phi[:, :, None] * phi[:, None, :]
    identity = np.eye(3)
    rotation = (
        (1.0 - versine * squared)[:, None, None] * identity
        + sine[:, None, None] * skew
        + versine[:, None, None] * outer
    )
    jacobian = sine[:, None, None] * identity - versine[:, None, None] * skew + cubic[:, None, None] * outer
    return rotation, jacobian


def cumulative_products(steps: Array) -> Array:
    """Products from the left, (N + 1, 3, 3): the identity, then ``steps[0] @ … @ steps[k]``.

    Few steps are scanned by doubling (Hillis & Steele 1986): log₂ N rounds over all of them. Many are first
    multiplied in pairs, whose products are scanned in turn (Ladner & Fischer 1980): 2 N products altogether.
    Either way rounding grows with log N only, and Python sees some thirty calls for 20 000 samples.
    """
    count = len(steps)
    products = np.empty((count + 1, 3, 3))
    products[0] = np.eye(3)
    if count > _FEW:
        paired = count - count % 2
        products[0 : paired + 1 : 2] = cumulative_products(steps[0:paired:2] @ steps[1:paired:2])
        products[1::2] = products[0:count:2] @ steps[0::2]
        return products
    products[1:] = steps
    distance = 1
    while distance <= count:
        products[distance:] = products[:-distance] @ products[distance:]
        distance *= 2
    return products
