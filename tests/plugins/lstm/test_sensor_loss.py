"""A camera or an inertial sensor that falls silent, at once or later: it goes on, says so, and recovers."""

import functools
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'vioframe[learn]'")
pytest.importorskip("safetensors", reason="needs safetensors: pip install 'vioframe[learn]'")

import torch

from filter_runs import assert_honest, play, record, simulated
from vioframe.types import Frame, ImuBlock, RelativePose
from vioframe_lstm import LstmFuser, PoseOptions, ResidualOptions

RATE_HZ = 20
LOST = pytest.mark.parametrize(
    ("lost", "first_s", "seconds_long"),
    [
        ("camera", 0.0, 1.0),
        ("camera", 2.5, 5.0),
        ("inertial", 0.0, 1.0),
        ("inertial", 2.5, 5.0),
        ("both", 2.5, 1.0),
    ],
)


@functools.cache
def walk():
    recording = simulated("walk", 9.5, seed=7)
    return recording, record(recording, rotation_noise=0.002, translation_noise=0.02)


def lstm(head):
    torch.manual_seed(1)
    return LstmFuser(
        head=head, frames=20, pose=PoseOptions(width=0.1), residual=ResidualOptions(channels=8), device="cpu"
    )


def blind(measurement):
    window = replace(measurement.window, current=Frame(stamp_ns=measurement.window.current.stamp_ns, images=()))
    return replace(measurement, window=window, relative_pose=RelativePose.invalid())


def numb(measurement):
    window = replace(measurement.window, imu=ImuBlock.none(), gap_ns=0)
    return replace(measurement, window=window, inertial_delta=None)


LOSSES = {"camera": blind, "inertial": numb, "both": lambda measurement: numb(blind(measurement))}


@functools.cache
def played(head, lost, first_s, seconds_long):
    recording, run = walk()
    first = round(first_s * RATE_HZ)
    last = first + round(seconds_long * RATE_HZ)
    out = play(lstm(head), recording, run, change=lambda i, m: LOSSES[lost](m) if first <= i < last else m)
    assert len(out.states) == len(run.measurements) + 1
    # State i + 1 closes window i.
    return out, first, last


@pytest.mark.parametrize("head", ["residual", "pose"])
@LOST
def test_goes_on(head, lost, first_s, seconds_long):
    out, first, last = played(head, lost, first_s, seconds_long)
    assert all(np.isfinite(state.T_world_body).all() for state in out.states)
    if lost != "inertial":
        assert out.counters["missing VO updates"] == last - first
        late = out.states[first + RATE_HZ + 2 : last + 1]
        assert {state.status for state in late} <= {"lost"}
    assert {state.status for state in out.states[last + 2 :]} == {"tracking"}


@LOST
def test_the_covariance_grows_and_recovers(lost, first_s, seconds_long):
    """Untrained, the residual head is a filter: what it says of velocity and position must hold all along."""
    out, first, last = played("residual", lost, first_s, seconds_long)
    assert_honest(out.states)
    velocity = np.array([np.sqrt(np.trace(state.covariance[6:9, 6:9])) for state in out.states])
    if seconds_long > 1.0:
        assert velocity[last] > 2.0 * velocity[first]
    settled = min(last + 2 * RATE_HZ, len(out.states) - 1)
    assert velocity[settled] < 1.5 * velocity[:first].max(initial=velocity[-1])
    spread = np.array([np.sqrt(np.trace(state.covariance[3:6, 3:6])) for state in out.states])
    assert (out.position_errors() < 4.0 * spread + 0.01).all()


def test_a_stream_that_breaks_off_is_taken_up():
    """Windows that never come: memory begins anew, the state goes on."""
    recording, run = walk()
    for head in ("residual", "pose"):
        part = lstm(head)
        out = play(part, recording, replace(run, measurements=run.measurements[:25] + run.measurements[35:60]))
        assert out.counters["missing windows"] == 1
        assert out.states[-1].status == "tracking"
