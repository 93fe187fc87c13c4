"""How fast the simulator draws: frames a second of one thread, each family with its own camera.

    python benchmarks/render.py

Times are processor seconds, so that other work on the machine does not count.
"""

# ruff: noqa: E402
import os

# Before numpy is imported: one thread is what is promised.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import time

import cv2
import numpy as np

from vioframe.data.simulator import CameraSettings, Degradations, SimulatedDataset

CASES: dict[str, tuple[str, CameraSettings, Degradations]] = {
    "walk, 752x480": ("walk", CameraSettings(), Degradations()),
    "walk, stereo": ("walk", CameraSettings(count=2), Degradations()),
    "walk, rolling shutter": ("walk", CameraSettings(rolling_shutter_s=0.02), Degradations()),
    "walk, low light": ("walk", CameraSettings(), Degradations(low_light=0.9)),
    "walk, motion blur": ("walk", CameraSettings(), Degradations(motion_blur_s=0.02)),
    "drone, 752x480": ("drone", CameraSettings(), Degradations()),
    "corridor, 752x480": ("corridor", CameraSettings(), Degradations()),
    "walk, 512x512 fisheye": ("walk", CameraSettings(kit="tumvi"), Degradations()),
    "car, 752x480": ("car", CameraSettings(kit="euroc"), Degradations()),
    "car, 1241x376": ("car", CameraSettings(), Degradations()),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=60)
    count = parser.parse_args().frames
    cv2.setNumThreads(1)
    print(f"{'case':<24}{'world s':>9}{'ms/frame':>10}{'slowest':>9}{'frames/s':>10}")
    for name, (family, camera, degradations) in CASES.items():
        dataset = SimulatedDataset(sequence=family, camera=camera, degradations=degradations, duration_s=30.0)
        recording = dataset.open(f"{family}-0")
        started = time.process_time()
        imager = recording.imager
        imager.images(0.0)
        world_s = time.process_time() - started
        spent = []
        for t_s in np.linspace(0.5, 29.5, count):
            started = time.process_time()
            imager.images(float(t_s))
            spent.append(time.process_time() - started)
        mean = float(np.mean(spent))
        print(f"{name:<24}{world_s:>9.2f}{1e3 * mean:>10.1f}{1e3 * max(spent):>9.1f}{1 / mean:>10.1f}")


if __name__ == "__main__":
    main()
