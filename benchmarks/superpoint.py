"""SuperPoint's time by stage, its three encoders side by side in one run.

    python benchmarks/superpoint.py speed
    python benchmarks/superpoint.py speed --device cuda --rounds 200

What a frame costs through the front end, in its stages, as medians over frames of a drawn scene that moves. The
encoders take turns, so that what else the machine does slows all of them. On a CPU it keeps to one thread, whose own
time is counted.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

import cv2
import numpy as np
import torch

from vioframe.types import Camera, Frame, ImuNoise, SensorRig
from vioframe_superpoint import Encoder, SuperPointFrontend
from vioframe_superpoint.extractor import _FOLDER
from vioframe_superpoint.options import WIDTHS

# Yu et al. 2021, table 6: extraction and matching of 1156 frames on a GTX 1660, frames a second.
PAPER_HZ = {"vgg": 28, "ghostnet": 30, "mobilenetv2": 40}
STAGES = ("net", "suppression", "points", "descriptors", "matching")


class Scene:
    """Polygons over a textured ground, seen by a camera that moves two pixels a frame."""

    def __init__(self, width: int, height: int) -> None:
        rng = np.random.default_rng(0)
        wide = width + 400
        ground = rng.integers(60, 190, (height // 24 + 1, wide // 24 + 1)).astype(np.uint8)
        self._picture = cv2.resize(ground, (wide, height), interpolation=cv2.INTER_CUBIC)
        for _ in range(150):
            corners = rng.uniform((0, 0), (wide, height)) + rng.uniform(-40, 40, (4, 2))
            cv2.fillConvexPoly(self._picture, cv2.convexHull(corners.astype(np.int32)), int(rng.integers(0, 256)))
        self._size = width, height
        camera = Camera(
            model="pinhole",
            intrinsics_px=np.array([450.0, 450.0, (width - 1) / 2, (height - 1) / 2]),
            size_px=(width, height),
            T_body_cam=np.eye(4),
        )
        noise = ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=200.0)
        self.rig = SensorRig(cameras=(camera,), imu=noise)

    def frame(self, number: int) -> Frame:
        left = 2 * (number % 200)
        image = np.ascontiguousarray(self._picture[:, left : left + self._size[0]])
        return Frame(stamp_ns=50_000_000 * number, images=(image,))


class Stopwatch:
    """Time inside named stages, and outside of those within them."""

    def __init__(self, device: str) -> None:
        self._cuda = device == "cuda"
        self.spent: dict[str, float] = {}
        self._inner = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        outer, self._inner = self._inner, 0.0
        begun = self._now()
        yield
        whole = self._now() - begun
        self.spent[name] = self.spent.get(name, 0.0) + whole - self._inner
        self._inner = outer + whole

    def wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.stage(name):
                return function(*args, **kwargs)

        return timed

    def _now(self) -> float:
        if not self._cuda:
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()


class Timed:
    """One front end whose stages are timed."""

    def __init__(self, encoder: str, scene: Scene, device: str, weights: str) -> None:
        import vioframe_superpoint.net.keypoints as keypoints

        found = weights == "shipped" and (_FOLDER / f"{encoder}.safetensors").is_file()
        torch.manual_seed(0)
        self.frontend = SuperPointFrontend(
            encoder=Encoder(name=encoder, width=WIDTHS[encoder]), weights="shipped" if found else None, device=device
        )
        self.trained = found
        self.frontend.setup(scene.rig)
        self.watch = Stopwatch(device)
        net = self.frontend._superpoint._inference
        net.detect = self.watch.wrapped("net", net.detect)
        net.describe = self.watch.wrapped("descriptors", net.describe)
        self._keypoints, self._suppress = keypoints, self.watch.wrapped("suppression", keypoints.suppress)
        extractor = self.frontend._superpoint
        extractor.extract = self.watch.wrapped("points", extractor.extract)

    def run(self, frame: Frame) -> tuple[dict[str, float], int, int]:
        """Milliseconds by stage; points followed, and points found."""
        plain = self._keypoints.suppress
        self._keypoints.suppress = self._suppress
        self.watch.spent = {}
        try:
            with self.watch.stage("matching"):
                found = self.frontend.process(frame, np.eye(3))
        finally:
            self._keypoints.suppress = plain
        times = {stage: 1e3 * self.watch.spent[stage] for stage in STAGES}
        return times, len(found.tracks), len(found.tracks) + len(found.untracked)


def speed(arguments: argparse.Namespace) -> None:
    device = arguments.device
    cv2.setNumThreads(1)
    if device == "cpu":
        torch.set_num_threads(1)
    scene = Scene(arguments.width, arguments.height)
    timed = {encoder: Timed(encoder, scene, device, arguments.weights) for encoder in WIDTHS}
    rows: dict[str, list[tuple[dict[str, float], int, int]]] = {encoder: [] for encoder in timed}
    for number in range(arguments.rounds + arguments.warm):
        for encoder, each in timed.items():
            found = each.run(scene.frame(number))
            if number >= arguments.warm:
                rows[encoder].append(found)
    where = torch.cuda.get_device_name() + ", half precision" if device == "cuda" else "one CPU thread"
    print(f"{arguments.width}×{arguments.height}, {arguments.rounds} frames each in turns, medians, {where}\n")
    heads = ("encoder", *(f"{stage}, ms" for stage in STAGES), "frame, ms", "of VGG", "Hz", "paper's GPU, Hz", "points")
    print(" | ".join(heads))
    whole = {encoder: median(sum(times.values()) for times, _, _ in found) for encoder, found in rows.items()}
    for encoder, found in rows.items():
        stages = [f"{median(times[stage] for times, _, _ in found):.1f}" for stage in STAGES]
        points = f"{median(row[1] for row in found):.0f} of {median(row[2] for row in found):.0f}"
        shares = [f"{whole[encoder]:.1f}", f"{whole[encoder] / whole['vgg']:.2f}", f"{1e3 / whole[encoder]:.1f}"]
        name = encoder + " " * timed[encoder].trained + ("" if timed[encoder].trained else " (random)")
        print(" | ".join([name, *stages, *shares, str(PAPER_HZ[encoder]), points]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    fast = commands.add_parser("speed", help="milliseconds by stage, three encoders in one run")
    fast.add_argument("--width", type=int, default=640)
    fast.add_argument("--height", type=int, default=480)
    fast.add_argument("--rounds", type=int, default=15, help="frames of each encoder")
    fast.add_argument("--warm", type=int, default=2, help="frames before these, which do not count")
    fast.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    fast.add_argument("--weights", choices=("shipped", "random"), default="shipped", help="random where none came")
    fast.set_defaults(run=speed)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
