"""Consistency of the loosely coupled filters: ANEES per degree of freedom over seeded simulated runs.

    python benchmarks/consistency.py [--runs 50] [--family walk] [--seconds 8]

Each run has its own motion, its own inertial noise and biases, and its own ``vo=simulated`` noise, whose
covariance is the stated one. The filter starts from the truth displaced by a draw from the covariance that
it is told, so every one of the 15 errors is Gaussian as stated and the NEES must average 1 per degree of
freedom; over N runs the mean of the (strongly correlated) samples of a run counts as one.
"""

import argparse
import time
from dataclasses import dataclass

import numpy as np

from vioframe.data.simulated_vo import SimulatedVO
from vioframe.data.simulator import CameraSettings, SimulatedDataset
from vioframe.geometry import se3, so3
from vioframe.initialisation import initial_covariance
from vioframe.interfaces import Fuser
from vioframe.pipeline import Pipeline
from vioframe.types import ImuBias, NavState
from vioframe_ekf import EkfFuser
from vioframe_msf import MsfFuser
from vioframe_preintegration import Preintegration
from vioframe_sync import InterpolateSynchronizer

BLOCKS = {"orientation": slice(0, 3), "position": slice(3, 6), "velocity": slice(6, 9), "all 15": slice(0, 15)}


@dataclass(frozen=True)
class Run:
    """NEES per degree of freedom of one run, by block.

    Attributes:
        nees: averaged over its states.
        final: of its last state; over runs, times the degrees of freedom, an exact χ² sample.
        position_error_m: at the end.
        path_m: length of the path.
        update_ms: wall time of an update.
        states: as they came.
    """

    nees: dict[str, float]
    final: dict[str, float]
    position_error_m: float
    path_m: float
    update_ms: float
    states: list[NavState]


def make_fuser(name: str) -> Fuser:
    return {"ekf": EkfFuser, "msf": MsfFuser}[name]()


def run_once(name: str, seed: int, family: str, seconds_long: float, fuser: Fuser | None = None) -> Run:
    """One seeded run of a filter."""
    dataset = SimulatedDataset(
        sequence=family, seed=seed, duration_s=seconds_long, standstill_s=1.0, camera=CameraSettings(images=False)
    )
    recording = dataset.open(dataset.sequences[0])
    truth = recording.ground_truth()
    scale = 1.0 if name == "ekf" else 2.5
    vo = SimulatedVO(rotation_noise=0.002, translation_noise=0.02, scale=scale, seed=1000 + seed)
    fuser = fuser or make_fuser(name)
    pipeline = Pipeline(synchronizer=InterpolateSynchronizer(), vo=vo, integrator=Preintegration(), fuser=fuser)
    rng = np.random.default_rng(seed)
    samples = list(recording.samples())
    stamps = np.concatenate([s.block.stamps_ns for s in samples])
    biases = np.concatenate([np.concatenate([s.gyro_bias, s.accel_bias], axis=1) for s in samples])

    def true_state(stamp_ns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        index = int(np.searchsorted(truth.stamps_ns, stamp_ns))
        assert truth.stamps_ns[index] == stamp_ns
        bias = np.array([np.interp(stamp_ns - stamps[0], stamps - stamps[0], column) for column in biases.T])
        return truth.T_world_body[index], truth.v_world_body[index], bias

    def perturbed(stamp_ns: int) -> NavState:
        T, v, bias = true_state(stamp_ns)
        covariance = initial_covariance(
            T[:3, :3],
            tilt_sigma=0.01,
            yaw_sigma=0.005,
            position_sigma=0.01,
            velocity_sigma=0.02,
            gyro_bias_sigma=0.005,
            accel_bias_sigma=0.05,
        )
        error = rng.multivariate_normal(np.zeros(15), covariance)
        T = se3.from_parts(T[:3, :3] @ so3.exp(error[:3]).T, T[:3, 3] - error[3:6])
        given = ImuBias(gyro=bias[:3] - error[9:12], accel=bias[3:] - error[12:])
        return NavState(
            stamp_ns=stamp_ns, T_world_body=T, v_world_body=v - error[6:9], bias=given, covariance=covariance
        )

    pipeline.setup(recording.rig, initial_state=perturbed)
    vo.take_ground_truth(truth)
    states = [state for state in pipeline.run(recording.packets()) if state.status == "tracking"]
    squares = {block: [] for block in BLOCKS}
    for state in states[1:]:
        T, v, bias = true_state(state.stamp_ns)
        error = np.concatenate(
            [
                so3.log(state.T_world_body[:3, :3].T @ T[:3, :3]),
                T[:3, 3] - state.T_world_body[:3, 3],
                v - state.v_world_body,
                bias[:3] - state.bias.gyro,
                bias[3:] - state.bias.accel,
            ]
        )
        for block, part in BLOCKS.items():
            square = error[part] @ np.linalg.solve(state.covariance[part, part], error[part])
            squares[block].append(square / len(error[part]))
    timer = pipeline.timers["fuser"]
    return Run(
        nees={block: float(np.mean(values)) for block, values in squares.items()},
        final={block: float(values[-1]) for block, values in squares.items()},
        position_error_m=float(np.linalg.norm(error[3:6])),
        path_m=float(np.linalg.norm(np.diff(truth.T_world_body[:, :3, 3], axis=0), axis=1).sum()),
        update_ms=1e3 * timer.seconds / timer.calls,
        states=states,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--family", default="walk")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--fusers", default="ekf,msf")
    arguments = parser.parse_args()
    for name in arguments.fusers.split(","):
        started = time.process_time()
        runs = [run_once(name, seed, arguments.family, arguments.seconds) for seed in range(arguments.runs)]
        print(
            f"fuser={name}: {len(runs)} runs of {arguments.seconds:g} s ({arguments.family}), "
            f"{time.process_time() - started:.0f} s CPU, {np.mean([r.update_ms for r in runs]):.2f} ms an update, "
            f"end error {np.mean([r.position_error_m for r in runs]):.3f} m "
            f"on {np.mean([r.path_m for r in runs]):.1f} m"
        )
        for block in BLOCKS:
            values = np.array([run.nees[block] for run in runs])
            spread = values.std(ddof=1) / np.sqrt(len(values))
            print(f"  ANEES/dof {block:<12} {values.mean():.3f} ± {spread:.3f}")


if __name__ == "__main__":
    main()
