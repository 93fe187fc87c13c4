"""The figures of learned odometry: how fast it is, and how far off after training from nothing.

    python benchmarks/learned.py throughput --small                        two cores, a minute
    python benchmarks/learned.py throughput                                512×256, ResNet-50, L = 10; best with a GPU
    python benchmarks/learned.py throughput --set vo=deepvo
    python benchmarks/learned.py accuracy                                  trainer=cpu, three seeds, simulated car
    python benchmarks/learned.py accuracy --set vo=deepvo --seeds 0
    python benchmarks/learned.py accuracy --set trainer=default training_data.train.seed='[0,1,2]' …

``throughput`` measures inference image by image, as ``python -m vioframe`` runs it, and batched; then training, with
decoded recordings of noise. The work of a net is told as a share of what this machine does in a matrix product of the
same precision (multiply and add are two operations), that of an unrolled solver as a share of the speed at which it
copies memory. ``accuracy`` runs ``python -m vioframe`` once a seed, which trains first and keeps what it trained in
``trainer.cache``; beside it stands constant motion, the mean motion of the training recordings, on the same images.
"""

import argparse
import json
from pathlib import Path

import learned_accuracy
import learned_speed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    figures = parser.add_subparsers(dest="figure", required=True)
    speed = figures.add_parser("throughput")
    speed.add_argument("--batch", type=int, help="answers at once; 64 on a GPU, else 4")
    speed.add_argument(
        "--precision", choices=learned_speed.PRECISIONS, help="of the batched net; bf16 on a GPU, else 32"
    )
    speed.add_argument(
        "--image", nargs=2, type=int, default=(1242, 375), help="width and height of the camera's images"
    )
    speed.add_argument("--seconds", type=float, default=5.0, help="of each measurement")
    speed.add_argument("--small", action="store_true", help="the sizes of trainer=cpu")
    speed.add_argument("--no-training", action="store_true", help="inference alone")
    accuracy = figures.add_parser("accuracy")
    accuracy.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    accuracy.add_argument("--folder", type=Path, default=Path("outputs/learned"), help="of the runs, one a seed")
    for figure in (speed, accuracy):
        figure.add_argument("--set", nargs="+", default=[], metavar="OVERRIDE", help="added to vo=tsvo fuser=vo_only")
        figure.add_argument("--json", type=Path, help="write every number into this file")
    options = parser.parse_args()
    if options.figure == "throughput":
        numbers = learned_speed.throughput(
            options.set,
            batch=options.batch,
            precision=options.precision,
            image=tuple(options.image),
            seconds=options.seconds,
            small=options.small,
            training=not options.no_training,
        )
    else:
        numbers = learned_accuracy.accuracy(options.set, options.seeds, options.folder)
    if options.json:
        options.json.write_text(json.dumps(numbers, indent=2) + "\n")


if __name__ == "__main__":
    main()
