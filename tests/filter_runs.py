"""Seeded runs of the loosely coupled filters on simulated motion, and the benchmark that makes them."""

import importlib.util
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType

import numpy as np

from vioframe.data.simulated_vo import SimulatedVO
from vioframe.data.simulator import CameraSettings, SimulatedDataset, SimulatedRecording
from vioframe.geometry import so3
from vioframe.interfaces import Fuser
from vioframe.pipeline import Pipeline
from vioframe.types import Measurement, NavState, Trajectory
from vioframe_preintegration import Preintegration
from vioframe_sync import InterpolateSynchronizer


def benchmark(name: str) -> ModuleType:
    """A module of the folder ``benchmarks``, which is no package."""
    path = Path(__file__).parents[1] / "benchmarks" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"benchmarks_{name}", path)
    if spec is None or spec.loader is None:
        raise ImportError(path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def simulated(family: str = "walk", seconds_long: float = 6.0, seed: int = 3, **options: object) -> SimulatedRecording:
    """A simulated sequence without images."""
    camera = CameraSettings(images=False)
    dataset = SimulatedDataset(sequence=family, seed=seed, duration_s=seconds_long, camera=camera, **options)
    return dataset.open(dataset.sequences[0])


@dataclass
class FilterRun:
    """What a fuser was given and what it said."""

    states: list[NavState] = field(default_factory=list)
    measurements: list[Measurement] = field(default_factory=list)
    truth: Trajectory | None = None
    counters: dict[str, int] = field(default_factory=dict)

    def true_pose(self, stamp_ns: int) -> np.ndarray:
        return self.truth.T_world_body[np.searchsorted(self.truth.stamps_ns, stamp_ns)]

    def true_state(self, stamp_ns: int) -> NavState:
        index = int(np.searchsorted(self.truth.stamps_ns, stamp_ns))
        return NavState(
            stamp_ns=stamp_ns,
            T_world_body=self.truth.T_world_body[index],
            v_world_body=self.truth.v_world_body[index],
        )

    def position_errors(self) -> np.ndarray:
        return np.array(
            [np.linalg.norm(s.T_world_body[:3, 3] - self.true_pose(s.stamp_ns)[:3, 3]) for s in self.states]
        )

    def rotation_errors(self) -> np.ndarray:
        return np.array([so3.angle(s.T_world_body[:3, :3].T @ self.true_pose(s.stamp_ns)[:3, :3]) for s in self.states])


def record(recording: SimulatedRecording, **vo_options: float) -> FilterRun:
    """The measurements of a sequence, without a fuser that uses them."""
    run = FilterRun(truth=recording.ground_truth())

    class Listener(Fuser):
        def update(self, measurement: Measurement) -> list[NavState]:
            run.measurements.append(measurement)
            return []

    vo = SimulatedVO(**vo_options)
    integrator = Preintegration()
    pipeline = Pipeline(synchronizer=InterpolateSynchronizer(), vo=vo, integrator=integrator, fuser=Listener())
    pipeline.setup(recording.rig)
    vo.take_ground_truth(run.truth)
    list(pipeline.run(recording.packets()))
    return run


def play(
    fuser: Fuser,
    recording: SimulatedRecording,
    run: FilterRun,
    *,
    from_truth: bool = True,
    change: Callable[[int, Measurement], Measurement] = lambda index, measurement: measurement,
    initial: NavState | None = None,
) -> FilterRun:
    """Give recorded measurements to a fuser; ``change`` may spoil each."""
    fuser.setup(recording.rig)
    out = FilterRun(truth=run.truth, measurements=run.measurements)
    if from_truth:
        fuser.start_from(initial or run.true_state(run.measurements[0].window.previous.stamp_ns))
    for index, measurement in enumerate(run.measurements):
        out.states += fuser.update(change(index, measurement))
    out.counters = dict(fuser.counters())
    return out


def without_vo(measurement: Measurement) -> Measurement:
    return replace(measurement, relative_pose=None)


def assert_honest(states: list[NavState]) -> None:
    """Every state is finite, every covariance exactly symmetric and positive, stamps increase."""
    stamps = [state.stamp_ns for state in states]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    for state in states:
        assert np.isfinite(state.T_world_body).all() and np.isfinite(state.v_world_body).all()
        np.testing.assert_array_equal(state.covariance, state.covariance.T)
        spread = np.sqrt(np.diag(state.covariance))
        assert np.linalg.eigvalsh(state.covariance / np.outer(spread, spread)).min() > -1e-9


def chi_square_interval(degrees: int, probability: float = 0.999) -> tuple[float, float]:
    """Two-sided interval of a χ² variable divided by its degrees of freedom."""
    from scipy.special import chdtri

    tail = 0.5 * (1.0 - probability)
    return float(chdtri(degrees, 1.0 - tail)) / degrees, float(chdtri(degrees, tail)) / degrees
