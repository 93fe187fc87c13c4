"""Flow front ends against the exact flow of simulated images: end-point error and processor time.

    OMP_NUM_THREADS=1 python benchmarks/flow.py [--size 512 256] [--seeds 10 11 12] [--scikit]

A car is seen at 10 Hz, a walk and a drone in every second image at 20 Hz. Only what is seen in both images counts.
``--scikit`` adds scikit-image's TV-L1 with the settings of the line before it (slow).
"""

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np

from vioframe.data.simulator import CameraSettings, SimulatedDataset
from vioframe.types import Frame, SensorRig
from vioframe_flow import DisFrontend, TvnetFrontend
from vioframe_flow.frontend import FlowFrontend

FAMILIES = {"car": 1, "walk": 2, "drone": 2}
SHARES = (0.5, 0.65, 0.8, 0.95)
GROSS_PX = 3.0
EQUAL = {"warps": 5, "iterations": 5, "coupling": 0.3, "max_scales": 5, "smoothing_px": 0.0, "trust_outside": True}

Pair = tuple[SensorRig, list[Frame], np.ndarray, np.ndarray]


def draw(family: str, seeds: list[int], size: tuple[int, int]) -> list[Pair]:
    """Rig, two frames, exact flow and what of it is seen."""
    pairs = []
    for seed in seeds:
        camera = CameraSettings(size_px=size)
        dataset = SimulatedDataset(sequence=family, seed=seed, duration_s=16.0, camera=camera)
        recording = dataset.open(dataset.sequences[0])
        stamps = recording.frame_stamps_ns
        for share in SHARES:
            first = int(share * (len(stamps) - 3))
            chosen = [int(stamps[first]), int(stamps[first + FAMILIES[family]])]
            frames = [
                Frame(stamp_ns=stamp, images=recording.imager.images(float(recording.elapsed_s(stamp))))
                for stamp in chosen
            ]
            pairs.append((recording.rig, frames, *recording.exact_flow(*chosen)))
    return pairs


def through(frontend: FlowFrontend) -> Callable[[Pair], tuple[np.ndarray, float]]:
    """Flow and milliseconds of one core, by a front end."""

    def run(pair: Pair) -> tuple[np.ndarray, float]:
        rig, frames, *_ = pair
        frontend.setup(rig)
        frontend.process(frames[0])
        begin = time.process_time()
        flow = frontend.process(frames[1]).flow
        assert flow is not None
        return flow, 1e3 * (time.process_time() - begin)

    return run


def by_scikit(pair: Pair) -> tuple[np.ndarray, float]:
    """The same by scikit-image, whose images span 0 … 1: its attachment is 255 λ."""
    from skimage.registration import optical_flow_tvl1

    images = np.stack([frame.images[0] for frame in pair[1]]).astype(np.float32)
    images = (images - images.min()) / np.ptp(images)
    begin = time.process_time()
    rows, columns = optical_flow_tvl1(
        *images, attachment=255 * 0.15, tightness=EQUAL["coupling"], num_warp=EQUAL["warps"], num_iter=5, tol=0.0
    )
    return np.stack([columns, rows], axis=-1), 1e3 * (time.process_time() - begin)


def main() -> None:
    """Print one line a front end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", nargs=2, type=int, default=(512, 256))
    parser.add_argument("--seeds", nargs="+", type=int, default=[10, 11, 12])
    parser.add_argument("--scikit", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    size = (options.size[0], options.size[1])
    plain = {"size_px": None, "quantise": False}
    solvers = {f"dis {preset}": through(DisFrontend(preset=preset, **plain)) for preset in ("ultrafast", "fast")}
    solvers["dis (default)"] = through(DisFrontend(**plain))
    solvers["dis (default), 256 levels"] = through(DisFrontend(size_px=None))
    solvers["tvnet (default)"] = through(TvnetFrontend(device="cpu", **plain))
    solvers["tvnet (default), 256 levels"] = through(TvnetFrontend(device="cpu", size_px=None))
    solvers["tvnet, paper's constants"] = through(
        TvnetFrontend(device="cpu", coupling=0.3, iterations=5, max_scales=5, smoothing_px=0.85, **plain)
    )
    solvers["tvnet, settings of scikit-image"] = through(TvnetFrontend(device="cpu", **EQUAL, **plain))
    if options.scikit:
        solvers["scikit-image, the same settings"] = by_scikit
    drawn = {family: draw(family, options.seeds, size) for family in FAMILIES}
    for family, pairs in drawn.items():
        lengths = np.concatenate([np.linalg.norm(truth[seen], axis=-1) for _, _, truth, seen in pairs])
        middle, most = np.quantile(lengths, (0.5, 0.99))
        print(f"{family}: {len(pairs)} pairs, flow of {middle:.1f} px in the median, 99 % below {most:.1f} px")
    for name, solve in solvers.items():
        cells, spent = [], []
        for pairs in drawn.values():
            errors = []
            for pair in pairs:
                flow, milliseconds = solve(pair)
                spent.append(milliseconds)
                errors.append(np.linalg.norm(flow - pair[2], axis=-1)[pair[3]])
            every = np.concatenate(errors)
            mean = np.mean([each.mean() for each in errors])
            cells.append(f"{mean:5.2f} {np.median(every):5.2f} {100 * np.mean(every > GROSS_PX):4.1f} %")
        print(f"{name:34s} | {' | '.join(cells)} | {np.median(spent):6.1f} ms", flush=True)


if __name__ == "__main__":
    main()
