"""What errors that motions share add up to in a chain of poses, against the sum written out."""

import numpy as np
import pytest

from vioframe.geometry import se3
from vioframe.pose_chain import LastingErrors, PoseChain
from vioframe.types import ImuBlock

NONE = ImuBlock(stamps_ns=np.zeros(0, np.int64), gyro=np.zeros((0, 3)), accel=np.zeros((0, 3)))


def begun():
    chain = PoseChain(levelled=False, tilt_sigma=1.0, rate_sigma=0.1, accel_sigma=1.0)
    chain.begin(0, None, NONE)
    return chain


@pytest.mark.parametrize("kept", [1.0, 0.8, 0.0])
def test_what_motions_share_adds_up_as_the_sum_of_all_of_it(kept):
    rng = np.random.default_rng(3)
    pairs, errors = 7, 4
    motions = se3.exp(rng.normal(0.0, 0.3, (pairs, 6)))
    roots = 0.1 * rng.standard_normal((pairs, 6, 6))
    jacobians = rng.standard_normal((pairs, 6, errors))
    variances = np.array([0.01, 0.04, 0.02, 0.09])
    chain = begun()
    first = chain.state("tracking").covariance[:6, :6]
    for k in range(pairs):
        lasting = LastingErrors(jacobian=jacobians[k], variances=variances, kept=np.full(errors, kept))
        chain.follow(motions[k], roots[k] @ roots[k].T, (k + 1) * 100_000_000, lasting=lasting)
    # The error of the last pose is that of each motion, moved to the end.
    onward = [np.eye(4)]
    for motion in motions[:0:-1]:
        onward.insert(0, motion @ onward[0])
    moved = [se3.adjoint(se3.inverse(each)) for each in onward]
    start = se3.adjoint(se3.inverse(motions[0] @ onward[0]))
    expected = start @ first @ start.T
    for i in range(pairs):
        expected += moved[i] @ roots[i] @ roots[i].T @ moved[i].T
        for j in range(pairs):
            shared = np.diag(variances * kept ** abs(i - j))
            expected += moved[i] @ jacobians[i] @ shared @ jacobians[j].T @ moved[j].T
    state = chain.state("tracking")
    into_state = np.eye(6)
    into_state[3:, 3:] = state.T_world_body[:3, :3]
    np.testing.assert_allclose(state.covariance[:6, :6], into_state @ expected @ into_state.T, rtol=1e-9, atol=1e-12)


def test_an_error_that_lasts_is_remembered_over_a_motion_that_nobody_knew():
    """A gyro that is off by 0.01 rad/s turns ten motions in a row by their sum, and eleven with one between."""

    def turned(unknown):
        chain = begun()
        before = chain.state("tracking").covariance[2, 2]
        for k in range(10):
            if unknown and k == 5:
                chain.coast((k + 1) * 100_000_000)
                continue
            jacobian = np.zeros((6, 1))
            jacobian[2] = 0.1
            chain.follow(
                np.eye(4),
                np.zeros((6, 6)),
                (k + 1) * 100_000_000,
                lasting=LastingErrors(jacobian=jacobian, variances=np.array([1e-4]), kept=np.ones(1)),
            )
        return chain.state("tracking").covariance[2, 2] - before

    assert turned(unknown=False) == pytest.approx((0.1 * 10 * 0.01) ** 2)
    # Nine of them, and what coasting adds: a rate of 0.1 rad/s from half a motion ago on.
    drift = 0.1**2 * (0.15**2 - 0.05**2)
    assert turned(unknown=True) == pytest.approx((0.1 * 9 * 0.01) ** 2 + drift)
