"""The figures of loosely coupled fusion, learned and not, each by one command.

    python benchmarks/fusion.py kitti --root DATA/kitti                    leave-one-out table on real inertial samples
    python benchmarks/fusion.py kitti --root DATA/kitti --rows ekf lstm --sequences 07 --seeds 0
    python benchmarks/fusion.py euroc --root DATA/euroc_imu_gt             the same on EuRoC, odometry on replays
    python benchmarks/fusion.py euroc_drawn --root DATA/euroc_imu_gt       the same with drawn errors of odometry
    python benchmarks/fusion.py sensor_loss                                1 s and 5 s without camera, without IMU
    python benchmarks/fusion.py anees                                      ANEES on simulated drives nobody learned from
    python benchmarks/fusion.py latency                                    ms a frame of each fuser, one thread

DATA is the folder of recordings in their native layout. A row is a system; learned ones are trained first, once for
each left-out sequence and seed, and found again in ``trainer.cache``. Runs are kept in ``--cells``, a JSON file each,
so a table that was stopped goes on, and what is there is not run again.
"""

import argparse
import json
import time
from pathlib import Path

import fusion_figures as figures
from playing import use_one_thread

FIGURES = {
    figure.__name__: figure
    for figure in (
        figures.kitti,
        figures.euroc,
        figures.euroc_drawn,
        figures.sensor_loss,
        figures.anees,
        figures.latency,
    )
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", choices=FIGURES)
    parser.add_argument("--root", default="", help="folder of the recordings")
    parser.add_argument("--rows", nargs="+", choices=figures.ROWS, default=None, help="systems; all that fit")
    parser.add_argument("--sequences", nargs="+", default=None, help="of the recordings; all of the table")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--cells", type=Path, default=Path("outputs/fusion/cells"), help="folder of the runs")
    parser.add_argument("--set", nargs="+", default=[], metavar="OVERRIDE", help="added to every row")
    parser.add_argument("--again", action="store_true", help="run what is there once more")
    parser.add_argument("--json", type=Path, help="write every number into this file")
    arguments = parser.parse_args()
    use_one_thread()
    started = time.perf_counter()
    options = figures.Options(
        root=arguments.root,
        rows=None if arguments.rows is None else tuple(arguments.rows),
        sequences=None if arguments.sequences is None else tuple(arguments.sequences),
        seeds=tuple(arguments.seeds),
        cells=arguments.cells,
        more=tuple(arguments.set),
        again=arguments.again,
    )
    numbers = FIGURES[arguments.figure](options)
    print(f"\n{time.perf_counter() - started:.0f} s")
    if arguments.json:
        arguments.json.write_text(json.dumps({"figure": arguments.figure, "numbers": numbers}, indent=2) + "\n")


if __name__ == "__main__":
    main()
