"""States on disk come back as they went in, and the process does not grow."""

import numpy as np
import pytest

from vioframe.geometry import se3
from vioframe.state_log import StateLog
from vioframe.types import ImuBias, NavState


def states(count):
    random = np.random.default_rng(0)
    for k in range(count):
        yield NavState(
            stamp_ns=1_403_715_273_262_142_976 + k,
            T_world_body=se3.exp(random.normal(size=6)),
            v_world_body=random.normal(size=3),
            bias=ImuBias(gyro=random.normal(size=3), accel=random.normal(size=3)),
            covariance=np.diag(random.uniform(size=15)) if k % 2 else None,
            status=("starting", "tracking", "lost")[k % 3],
        )


def test_what_goes_in_comes_out(tmp_path):
    log = StateLog(tmp_path)
    given = list(states(700))
    for state in given:
        log.append(state)
    assert len(log) == 700
    for before, after in zip(given, log, strict=True):
        assert before.stamp_ns == after.stamp_ns and before.status == after.status
        np.testing.assert_array_equal(before.T_world_body, after.T_world_body)
        np.testing.assert_array_equal(before.v_world_body, after.v_world_body)
        np.testing.assert_array_equal(before.bias.accel, after.bias.accel)
        assert (before.covariance is None) == (after.covariance is None)
        if before.covariance is not None:
            np.testing.assert_array_equal(before.covariance, after.covariance)
    assert log[-1].stamp_ns == given[-1].stamp_ns
    assert [s.stamp_ns for s in log[3:9:2]] == [s.stamp_ns for s in given[3:9:2]]
    with pytest.raises(IndexError):
        log[700]


def test_appending_goes_on_after_reading(tmp_path):
    log = StateLog(tmp_path)
    given = list(states(4))
    log.append(given[0])
    assert log[0].stamp_ns == given[0].stamp_ns
    log.append(given[1])
    assert [s.stamp_ns for s in log] == [s.stamp_ns for s in given[:2]]
