"""Where the parameters of vo=error_model come from: the shape of a net's errors, and their level on KITTI.

python benchmarks/vo_errors.py shape vo=tsvo trainer=cpu trainer.max_epochs=16 [vo.weights=FILE] [more overrides]
python benchmarks/vo_errors.py level --root DATA/kitti [--seeds 8] [overrides, such as vo.rotation_level=1.1]
"""

import argparse
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from playing import compose_config

from vioframe.build import build, build_dataset, build_pipeline
from vioframe.checks import Array
from vioframe.data.error_fit import AnsweredMotions, fit_errors
from vioframe.data.error_model_vo import ErrorModelVO
from vioframe.data.recording import Recording
from vioframe.evaluation.align import MatchedPoses
from vioframe.evaluation.metrics import segment_errors
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.interfaces import VOEstimator
from vioframe.learning.scoring import chain
from vioframe.tasks.answers import read_answered_splits
from vioframe.tasks.fitting import trainer_options
from vioframe.tasks.provision import provide_weights
from vioframe.types import Frame, VisualFeatures

SEQUENCES = ["01", "02", "04", "06", "07", "08"]
_LENGTHS_M = [100.0 * k for k in range(1, 9)]
_STEP = 10
_MAX_GAP_NS = 110_000_000


def shape(overrides: Sequence[str]) -> None:
    """Fit the model to what a VO answers on the validation recordings; train the VO first where it has no weights."""
    config = compose_config("fuser=vo_only", "integrator=none", *overrides)
    choices = {"vo": "vo", "trainer": "trainer", "training_data": "training_data"}
    provide_weights(config, choices, build_pipeline(config, choices), build_dataset(config, choices), shown=True)
    _, validation = read_answered_splits(config, trainer_options(config, choices), choices, shown=True)
    answered = []
    for sequence in validation.sequences:
        if sequence.vo is None:
            continue
        true, known = sequence.motions(), sequence.known[:-1] & sequence.known[1:]
        turned = sequence.vo.T_prev_cur.copy()
        turned[:, :3, :3] = true[:, :3, :3]
        moved = sequence.vo.T_prev_cur.copy()
        moved[:, :3, 3] = true[:, :3, 3]
        for words, motions in (("", sequence.vo.T_prev_cur), ("true rotation", turned), ("true translation", moved)):
            t_rel, r_rel = drift(motions, true, sequence.stamps_ns)
            print(f"{sequence.name:12s} {words:18s} t_rel {t_rel:5.2f} %  r_rel {r_rel:5.2f} °/100 m")
        answered.append(
            AnsweredMotions(
                T_true=true,
                T_estimate=sequence.vo.T_prev_cur,
                duration_s=np.diff(sequence.stamps_ns) * 1e-9,
                valid=known & sequence.vo.valid,
            )
        )
    print(fit_errors(answered))


def level(root: str, seeds: int, overrides: Sequence[str]) -> None:
    """Chain what vo=error_model answers on KITTI, over seeds."""
    names = ",".join(f"'{name}'" for name in SEQUENCES)
    config = compose_config(
        "fuser=vo_only",
        "vo=error_model",
        "dataset=kitti",
        f"dataset.root={root}",
        f"dataset.sequence=[{names}]",
        *overrides,
    )
    dataset = build_dataset(config, {})
    table = np.zeros((len(SEQUENCES), seeds, 2))
    for row, name in enumerate(dataset.sequences):
        recording = dataset.open(name)
        for seed in range(seeds):
            config.vo.seed = seed
            vo = build(config, "vo", VOEstimator)
            if isinstance(vo, ErrorModelVO):
                table[row, seed] = _level(vo, recording)
        print(
            f"{name}  t_rel {table[row, :, 0].mean():5.2f} %  r_rel {table[row, :, 1].mean():5.2f} °/100 m", flush=True
        )
    by_seed = table.mean(axis=0)
    words = ", ".join(f"{t:.2f}/{r:.2f}" for t, r in by_seed)
    print(f"mean t_rel {by_seed[:, 0].mean():.2f} %, r_rel {by_seed[:, 1].mean():.2f} °/100 m; by seed {words}")


def _level(vo: ErrorModelVO, recording: Recording) -> tuple[float, float]:
    truth = recording.ground_truth()
    if truth is None:
        raise SystemExit(f"{recording.name} has no ground truth")
    delay_ns = recording.rig.camera_delay_ns
    frames = [packet for packet in recording.packets() if isinstance(packet, Frame)]
    stamps = np.array([frame.stamp_ns + delay_ns for frame in frames])
    poses, covered = interpolate_poses(truth, stamps, max_gap_ns=_MAX_GAP_NS)
    stamps, T_world_cam = stamps[covered], poses[covered] @ recording.rig.cameras[0].T_body_cam
    vo.setup(recording.rig)
    vo.take_ground_truth(truth)
    seen = [VisualFeatures(frame=Frame(stamp_ns=int(stamp))) for stamp in stamps]
    motions = np.array([vo.estimate(one, two).T_prev_cur for one, two in pairwise(seen)])
    return drift(motions, np.linalg.inv(T_world_cam[:-1]) @ T_world_cam[1:], stamps)


def drift(motions: Array, true: Array, stamps_ns: np.ndarray) -> tuple[float, float]:
    """t_rel, %, and r_rel, °/100 m, of motions (P, 4, 4) beside the true ones."""
    estimate, truth = chain(motions, np.eye(4)), chain(true, np.eye(4))
    numbers = np.arange(len(truth))
    matched = MatchedPoses(
        stamps_ns=stamps_ns,
        T_estimate=estimate,
        T_truth=truth,
        estimate_index=numbers,
        frames=numbers,
        T_truth_frames=truth,
    )
    errors = segment_errors(matched, _LENGTHS_M, _STEP)
    return errors.t_rel_percent, errors.r_rel_deg_per_100m


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", choices=["shape", "level"])
    parser.add_argument("--root", help="folder of KITTI")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("overrides", nargs="*")
    arguments = parser.parse_args()
    if arguments.figure == "shape":
        shape(arguments.overrides)
    elif arguments.root:
        level(arguments.root, arguments.seeds, arguments.overrides)
    else:
        parser.error("level needs --root")


if __name__ == "__main__":
    main()
