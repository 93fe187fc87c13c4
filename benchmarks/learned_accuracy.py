"""Errors on held-out recordings after training from nothing, over seeds, beside constant motion."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
from playing import compose_config

from vioframe.build import build_dataset
from vioframe.errors import MetricError
from vioframe.evaluation.rows import compare_trajectories
from vioframe.geometry import se3
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.learning.options import TrainerOptions
from vioframe.learning.scoring import chain, mean_motion
from vioframe.tasks.decoding import read_splits
from vioframe.tasks.experiment import build_options
from vioframe.tasks.fitting import trainer_options
from vioframe.trajectory_io import read_trajectory
from vioframe.types import Trajectory

_MAX_TRUTH_GAP_NS = 110_000_000
METRICS = ("t_rel_percent", "r_rel_deg_per_100m")

Numbers = dict[str, object]


def accuracy(overrides: Sequence[str], seeds: Sequence[int], folder: Path) -> Numbers:
    """Run an experiment a seed, print a table and return its numbers."""
    chosen = ["vo=tsvo", "fuser=vo_only", "integrator=none", *overrides]
    runs = {seed: _run(chosen, seed, folder / f"seed{seed}") for seed in seeds}
    config = compose_config(*chosen)
    documents = [json.loads((path / "metrics.json").read_text()) for path in runs.values()]
    names = [row["sequence"] for row in documents[0]["sequences"]]
    constant = _constant(config, next(iter(runs.values())), names)
    print(f"{'':24s} | {'t_rel [%]':^42s} | {'r_rel [°/100 m]':^42s}")
    heads = f"{'median':>8s} {'range over seeds':>20s} {'constant':>10s}"
    print(f"{'test recording':24s} | {heads:>42s} | {heads:>42s} |  both below ½ of constant motion")
    table: Numbers = {}
    for name in [*names, "mean"]:
        cells, met = [], []
        entry: dict[str, object] = {}
        for metric in METRICS:
            found = [_value(document, name, metric) for document in documents]
            beside = _mean([constant[each][metric] for each in names]) if name == "mean" else constant[name][metric]
            if any(value is None for value in found) or beside is None:
                cells.append(f"{'undefined':>42s}")
                met.append(False)
                continue
            known = [value for value in found if value is not None]
            middle = median(known)
            cells.append(f"{middle:8.2f} {f'{min(known):.2f} to {max(known):.2f}':>20s} {beside:10.2f}  ")
            met.append(middle <= 0.5 * beside)
            entry[metric] = {"seeds": known, "median": middle, "constant_motion": beside}
        table[name] = entry
        print(f"{name:24s} | {' | '.join(cells)} |  {'yes' if all(met) else 'no'}")
    print(f"seeds {', '.join(map(str, seeds))}; {' '.join(chosen)}; runs in {folder}")
    return {"overrides": chosen, "seeds": list(seeds), "recordings": table}


def _run(overrides: Sequence[str], seed: int, folder: Path) -> Path:
    command = [sys.executable, "-m", "vioframe", *overrides, f"trainer.seed={seed}", f"hydra.run.dir={folder}"]
    print(" ".join(command[1:]), flush=True)
    done = subprocess.run(command, check=False)
    if done.returncode:
        raise SystemExit(f"seed {seed} ended with status {done.returncode}: see above")
    return folder


def _constant(config, run: Path, names: Sequence[str]) -> dict[str, dict[str, float | None]]:
    """Errors of constant motion on the images that the run has answered for."""
    choices: dict[str, str] = {}
    options: TrainerOptions = trainer_options(config, choices)
    # Decoded already: the run has learned from it.
    training, _ = read_splits(config, options, choices, shown=False)
    T_prev_cur_cam = mean_motion(training.sequences)
    dataset = build_dataset(config)
    found = {}
    for name in names:
        recording = dataset.open(name)
        truth = recording.ground_truth()
        if truth is None:
            raise SystemExit(f"{name} has no ground truth")
        place = run if len(names) == 1 else run / name
        stamps = read_trajectory(place / "trajectory.tum").stamps_ns
        poses, known = interpolate_poses(truth, stamps, max_gap_ns=_MAX_TRUTH_GAP_NS)
        begin = int(np.argmax(known))
        stamps, first = stamps[begin:], poses[begin]
        T_body_cam = recording.rig.cameras[0].T_body_cam
        T_prev_cur = T_body_cam @ T_prev_cur_cam @ se3.inverse(T_body_cam)
        # Where images are missing, it goes on for as many usual intervals.
        steps = np.diff(stamps)
        counts = np.round(steps / np.median(steps))
        motions = se3.exp(counts[:, None] * se3.log(T_prev_cur[None]))
        estimate = Trajectory(stamps_ns=stamps, T_world_body=chain(motions, first))
        try:
            row = compare_trajectories(estimate, truth, build_options(config), alignment="se3")
        except MetricError:
            row = {}
        found[name] = {metric: _number(row.get(metric)) for metric in METRICS}
    return found


def _value(document: dict, name: str, metric: str) -> float | None:
    rows = [row for row in document["sequences"] if name in (row["sequence"], "mean")]
    return _mean([_number(row.get(metric)) for row in rows])


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
