"""The figures of the tightly coupled systems, each by one command.

    python benchmarks/tight.py accuracy --root DATA/euroc_imu_gt          five replays, three seeds, mono and stereo
    python benchmarks/tight.py accuracy --root … --sequences V1_01_easy --seeds 0 --rigs mono --fusers msckf
    python benchmarks/tight.py offset --seeds 0 [--root … --sequences …]  a camera clock that is off by −50…50 ms
    python benchmarks/tight.py extrinsics --seeds 0 [--root …]            a camera turned by 3° against its calibration
    python benchmarks/tight.py faults                                     a lost camera, dropped frames, an IMU gap
    python benchmarks/tight.py consistency                                ANEES over 30 simulated walks
    python benchmarks/tight.py still --root DATA/euroc_V1_01_micro        real images of a vehicle that stands
    python benchmarks/tight.py kitti --root DATA/kitti                    real images, moving start
    python benchmarks/tight.py loop --rigs mono                           around a building, with and without loop

DATA is the folder of recordings in their native layout. Every image is drawn once and goes through each system as
``python -m vioframe`` would bring it there, front end included. One thread; times are CPU milliseconds an image, from
the images in memory to the pose: tracking (front end), back end (fuser and integrator), framework (the rest).
"""

import argparse
import json
import math
import time
from pathlib import Path

import tight_figures as figures
from playing import use_one_thread

FIGURES = {
    figure.__name__: figure
    for figure in (
        figures.accuracy,
        figures.offset,
        figures.extrinsics,
        figures.faults,
        figures.consistency,
        figures.still,
        figures.kitti,
        figures.loop,
    )
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", choices=FIGURES)
    parser.add_argument("--root", default="", help="folder of the recordings")
    parser.add_argument("--sequences", nargs="+", default=list(figures.SEQUENCES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--fusers", nargs="+", default=["msckf", "window"])
    parser.add_argument("--rigs", nargs="+", choices=figures.CAMERAS, default=list(figures.CAMERAS))
    parser.add_argument("--seconds", type=float, help="of each sequence, instead of what the figure asks for")
    parser.add_argument("--runs", type=int, default=30, help="of the consistency")
    parser.add_argument("--set", nargs="+", default=[], metavar="OVERRIDE", help="added to every system")
    parser.add_argument("--scratch", type=Path, help="keep what was drawn there for the next time, 1 GB a minute")
    parser.add_argument("--json", type=Path, help="write every number into this file")
    arguments = parser.parse_args()
    use_one_thread()
    started = time.perf_counter()
    options = figures.Options(
        root=arguments.root,
        sequences=tuple(arguments.sequences),
        seeds=tuple(arguments.seeds),
        fusers=tuple(arguments.fusers),
        rigs=tuple(arguments.rigs),
        more=tuple(arguments.set),
        seconds=arguments.seconds,
        runs=arguments.runs,
        scratch=arguments.scratch,
    )
    entries = FIGURES[arguments.figure](options)
    print(f"\n{time.perf_counter() - started:.0f} s")
    if arguments.json:
        plain = [{key: _plain(value) for key, value in row.items()} for row in entries]
        arguments.json.write_text(json.dumps({"figure": arguments.figure, "runs": plain}, indent=2) + "\n")


def _plain(value: object) -> object:
    """JSON knows no infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    main()
