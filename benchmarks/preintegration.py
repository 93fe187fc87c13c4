"""Time and accuracy of the integrators, with gtsam's preintegration in the same run.

    python benchmarks/preintegration.py

Times are processor seconds of one thread, the best of several runs. gtsam is called once a sample from
Python, as its interface wants it; the samples are already numpy arrays.
"""

# ruff: noqa: E402
import os

# Before numpy is imported: threads of the linear algebra would be counted as processor time.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vioframe.geometry import so3
from vioframe.types import ImuBias
from vioframe_preintegration import Preintegration, Strapdown

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from inertial_truth import NOISE, even_stamps, exact_increment, make_rig, samples

LIMIT = 2.0
"""Largest allowed ratio of our time to gtsam's (issue "Spine")."""


def best_of(call: Callable[[], object], repeats: int) -> float:
    taken = []
    for _ in range(repeats):
        started = time.process_time()
        call()
        taken.append(time.process_time() - started)
    return min(taken)


def gtsam_loop(accel: np.ndarray, gyro: np.ndarray, step: float, combined: bool) -> Callable[[], object]:
    import gtsam

    kind = gtsam.PreintegrationCombinedParams if combined else gtsam.PreintegrationParams
    params = kind.MakeSharedU(9.81)
    params.setGyroscopeCovariance(NOISE.gyro_noise**2 * np.eye(3))
    params.setAccelerometerCovariance(NOISE.accel_noise**2 * np.eye(3))
    params.setIntegrationCovariance(1e-10 * np.eye(3))

    def run() -> object:
        if combined:
            measurements = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias())
        else:
            measurements = gtsam.PreintegratedImuMeasurements(params)
        for force, rate in zip(accel, gyro, strict=True):
            measurements.integrateMeasurement(force, rate, step)
        return measurements

    return run


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    count = arguments.samples
    imu = samples(even_stamps(0.0, count / 200.0, count))
    bias = ImuBias()
    midpoint, strapdown = Preintegration(), Strapdown()
    for integrator in (midpoint, strapdown):
        integrator.setup(make_rig(NOISE))

    ours = best_of(lambda: midpoint.integrate(imu, bias), arguments.repeats)
    print(f"{count} samples at 200 Hz")
    print(f"  preintegration (midpoint, with Jacobians, covariance and path)  {1e3 * ours:8.1f} ms")
    worst = 0.0
    for name, combined in (("PreintegratedImuMeasurements", False), ("PreintegratedCombinedMeasurements", True)):
        theirs = best_of(gtsam_loop(imu.accel[:-1], imu.gyro[:-1], 1 / 200.0, combined), arguments.repeats)
        print(f"  gtsam {name:<57s} {1e3 * theirs:8.1f} ms   ours / gtsam = {ours / theirs:.2f}")
        worst = max(worst, ours / theirs)

    for steps in (10, 20, 100):
        window = samples(even_stamps(0.0, steps / 200.0, steps))
        line = [f"  window of {steps:3d} steps:"]
        for name, integrator in (("preintegration", midpoint), ("strapdown", strapdown)):
            call = integrator.integrate
            taken = best_of(lambda call=call, window=window: [call(window, bias) for _ in range(50)], 5) / 50
            line.append(f"{name} {1e3 * taken:.3f} ms")
        print("  ".join(line))

    print("error of the increment over 1.6 s of brisk motion (rad, m/s, m), and the order of convergence")
    R, v, p = exact_increment(0.2, 1.8)
    euler = Preintegration(method="euler")
    for name, integrator in (("midpoint", midpoint), ("euler", euler), ("strapdown", strapdown)):
        integrator.setup(make_rig(NOISE))
        before = None
        for steps in (80, 160, 320, 640):
            delta = integrator.integrate(samples(even_stamps(0.2, 1.8, steps)), bias)
            error = np.array(
                [so3.angle(R.T @ delta.delta_R), np.linalg.norm(delta.delta_v - v), np.linalg.norm(delta.delta_p - p)]
            )
            order = "" if before is None else "  order " + " ".join(f"{x:.2f}" for x in np.log2(before / error))
            print(f"  {name:<10s} {steps / 1.6:5.0f} Hz  " + "  ".join(f"{x:.2e}" for x in error) + order)
            before = error

    met = worst <= LIMIT
    print(f"{'met' if met else 'NOT met'}: at most {LIMIT:g} times gtsam's time, here {worst:.2f}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
