"""What ``benchmarks/fusion.py`` measures: a function a figure."""

import time
from collections.abc import Sequence
from statistics import median

import numpy as np
from fusion_runs import FUSED, ROWS, Bench, Options, play

from vioframe.build import build_pipeline
from vioframe.conventions import NANOSECONDS
from vioframe.errors import VioframeError
from vioframe.evaluation.run import SequenceRun
from vioframe.geometry.interpolation import interpolate_poses
from vioframe.study.cells import CellResult
from vioframe.types import Measurement, NavState

__all__ = ["ROWS", "Options", "anees", "euroc", "euroc_drawn", "kitti", "latency", "sensor_loss"]

KITTI = ("01", "02", "04", "06", "07", "08")
EUROC = ("V1_01_easy", "V1_02_medium", "V2_01_easy", "MH_01_easy", "MH_04_difficult")
_TITLES = {
    "t_rel_percent": "t_rel [%]",
    "r_rel_deg_per_100m": "r_rel [°/100 m]",
    "ate_se3_m": "ATE [m]",
    "rpe_trans_percent_10m": "RPE over 10 m [%]",
    "rpe_rot_deg_10m": "RPE over 10 m [°]",
}
# A drive that no training or validation set holds, long enough to recover from five seconds of loss.
_DRIVE = (
    "dataset=simulated_car",
    "dataset.sequence=car",
    "dataset.duration_s=60",
    "vo=error_model",
    "init=groundtruth",
)
_LOST_AT_S = 30.0
_RECOVERY_S = 10.0

Numbers = dict[str, object]


def kitti(options: Options) -> Numbers:
    """Leave-one-out: each sequence by nets that learned from the others; real inertial samples, drawn odometry."""

    def overrides(sequence: str, seed: int) -> list[str]:
        return [
            "experiment=fusion_kitti",
            f"dataset.root={options.folder()}",
            f"dataset.sequence=['{sequence}']",
            # Said on the command line it wins over the odometry that a fuser brings.
            "vo=error_model",
            f"vo.seed={seed}",
            f"trainer.seed={seed}",
        ]

    return _leave_one_out(options, KITTI, overrides, ("t_rel_percent", "r_rel_deg_per_100m"))


def euroc(options: Options) -> Numbers:
    """Leave-one-out on replays of EuRoC: real inertial samples, stereo odometry on rendered images."""
    return _euroc(options, ["rig=stereo", "vo=stereo"], ["dataset.seed"])


def euroc_drawn(options: Options) -> Numbers:
    """The same with an odometry that errs as much as a learned one, drawn; no image is rendered."""
    return _euroc(options, ["rig=blind", "frontend=none", "vo=error_model"], ["vo.seed"])


def _euroc(options: Options, odometry: Sequence[str], seeds: Sequence[str]) -> Numbers:
    def overrides(sequence: str, seed: int) -> list[str]:
        return [
            "experiment=fusion_euroc",
            f"dataset.source.root={options.folder()}",
            f"dataset.source.sequence=[{sequence}]",
            *odometry,
            *(f"{name}={seed}" for name in (*seeds, "trainer.seed")),
        ]

    return _leave_one_out(options, EUROC, overrides, ("ate_se3_m", "rpe_trans_percent_10m", "rpe_rot_deg_10m"))


def _leave_one_out(options: Options, all_sequences: Sequence[str], overrides, metrics: Sequence[str]) -> Numbers:
    rows = options.rows or tuple(ROWS)
    sequences = options.sequences or tuple(all_sequences)
    results: dict[tuple[str, str, int], CellResult] = {}
    with Bench(options) as bench:
        for seed in options.seeds:
            for sequence in sequences:
                for row in rows:
                    result = bench.measure(row, overrides(sequence, seed))
                    results[row, sequence, seed] = result
                    told = "  ".join(f"{name} {result.metrics.get(name, float('nan')):.2f}" for name in metrics)
                    print(f"{row:10} {sequence:16} seed {seed}  {told}{'  (kept)' * result.stored}", flush=True)
    for metric in metrics:
        print(f"\n{_TITLES[metric]}, median of seeds {', '.join(map(str, options.seeds))} (range)")
        _print_table(rows, sequences, options.seeds, results, metric)
    return {
        f"{row} {sequence} {seed}": {name: result.metrics.get(name) for name in metrics} | {"error": result.error}
        for (row, sequence, seed), result in results.items()
    }


def _print_table(
    rows: Sequence[str],
    sequences: Sequence[str],
    seeds: Sequence[int],
    results: dict[tuple[str, str, int], CellResult],
    metric: str,
) -> None:
    lines = [["", *sequences, "mean"]]
    for row in rows:
        table = {s: [results[row, s, seed].metrics.get(metric) for seed in seeds] for s in sequences}
        # The mean over the sequences of each seed, so that its range is that of whole tables.
        means = [_mean([table[s][k] for s in sequences]) for k in range(len(seeds))]
        lines.append([row, *(_cell(table[s]) for s in sequences), _cell(means)])
    show(lines)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def _cell(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return "undefined"
    return f"{median(known):.3g}" + (f" ({min(known):.3g}…{max(known):.3g})" if len(known) > 1 else "")


def show(lines: Sequence[Sequence[str]]) -> None:
    """Print lines of cells below each other."""
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    for line in lines:
        print("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())


def sensor_loss(options: Options) -> Numbers:
    """One and five seconds without camera and without inertial samples, in mid-run and from the start."""
    cases = {
        f"{sensor} {length:g} s{where}": f"faults.{fault}=[[{start:g},{length:g}]]"
        for sensor, fault in (("camera", "camera_lost_s"), ("IMU", "imu_lost_s"))
        for length in (1.0, 5.0)
        for start, where in ((_LOST_AT_S, ""), (0.0, " at the start"))
    }
    heads = [
        "system",
        "lost",
        "error m: before",
        "in the end",
        "10 s after",
        "σ_p m",
        "",
        "",
        "σ_v m/s",
        "",
        "",
        "status",
    ]
    lines, numbers = [heads], {}
    with Bench(options) as bench:
        for row in options.rows or FUSED:
            for case, fault in cases.items():
                start = _LOST_AT_S if "start" not in case else 0.0
                found: list[Numbers] = []
                for seed in options.seeds:
                    overrides = [*_DRIVE, f"dataset.seed={seed}", f"vo.seed={seed}"]
                    try:
                        composed = bench.trained(row, [*overrides, fault], _WITHOUT_FAULTS)
                        run, _ = play(composed.config, composed.choices)
                        found.append(_around(run, start, float(case.split()[1])))
                    except VioframeError as error:
                        found.append({"status": f"{type(error).__name__}: {error}"})
                numbers[f"{row}, {case}"] = found
                lines.append([row, case, *_middle(found)])
                print(" ".join(lines[-1]), flush=True)
    print()
    show(lines)
    return numbers


# What holds for the runs and not for the training of what is run.
_WITHOUT_FAULTS = ("faults.camera_lost_s=[]", "faults.imu_lost_s=[]", "dataset.seed=0", "vo.seed=0")
_MOMENTS = ("before", "worst", "after")
_BADNESS = ("tracking", "starting", "lost")


def _around(run: SequenceRun, start_s: float, length_s: float) -> Numbers:
    """Largest error, standard deviations and statuses of the second before, of a loss, and of a second after it."""
    truth = run.ground_truth
    if truth is None or not len(run.states):
        return {"status": "no state"}
    first_ns = int(truth.stamps_ns[0])
    told: Numbers = {}
    start_ns, end_ns = (first_ns + round(at_s * NANOSECONDS) for at_s in (start_s, start_s + length_s))
    # What bridges a loss speaks again only with the first image or sample after it.
    spans = {
        "before": (start_ns - NANOSECONDS, start_ns),
        "worst": (start_ns, end_ns + NANOSECONDS // 2),
        "after": (end_ns + round(_RECOVERY_S * NANOSECONDS) - NANOSECONDS, end_ns + round(_RECOVERY_S * NANOSECONDS)),
    }
    for moment, (begin_ns, finish_ns) in spans.items():
        states = [state for state in run.states if begin_ns < state.stamp_ns <= finish_ns]
        if not states:
            continue
        stamps = np.array([state.stamp_ns for state in states])
        poses = interpolate_poses(truth, stamps, max_gap_ns=NANOSECONDS)[0]
        positions = np.array([state.T_world_body[:3, 3] for state in states])
        told[f"error_{moment}"] = float(np.linalg.norm(positions - poses[:, :3, 3], axis=1).max())
        known = [state.covariance for state in states if state.covariance is not None]
        if known:
            told[f"sigma_p_{moment}"] = max(float(np.sqrt(np.trace(P[3:6, 3:6]))) for P in known)
            told[f"sigma_v_{moment}"] = max(float(np.sqrt(np.trace(P[6:9, 6:9]))) for P in known)
        # The worst of them, so that a word that was said once is not missed.
        told[f"status_{moment}"] = max((state.status for state in states), key=_BADNESS.index)
    told["status"] = " → ".join(str(told.get(f"status_{moment}", "none")) for moment in _MOMENTS)
    return told


def _middle(found: Sequence[Numbers]) -> list[str]:
    cells = []
    for name in ("error", "sigma_p", "sigma_v"):
        for moment in _MOMENTS:
            values = [float(str(one[f"{name}_{moment}"])) for one in found if f"{name}_{moment}" in one]
            cells.append(f"{median(values):.2f}" if len(values) == len(found) and values else "–")
    return [*cells, " | ".join(dict.fromkeys(str(one["status"]) for one in found))]


def anees(options: Options) -> Numbers:
    """Average NEES a degree of freedom over drives that nobody learned from; 1 is consistent."""
    names = ("anees_orientation", "anees_position", "anees_pose")
    lines = [["system", *names, "drives"]]
    numbers: Numbers = {}
    with Bench(options) as bench:
        for row in options.rows or FUSED:
            found: dict[str, list[float]] = {name: [] for name in names}
            for seed in options.seeds:
                overrides = [*_DRIVE, f"dataset.seed={seed}", f"vo.seed={seed}"]
                result = bench.measure(row, overrides, _WITHOUT_FAULTS)
                for name in names:
                    if name in result.metrics:
                        found[name].append(result.metrics[name])
            numbers[row] = found
            means = [f"{np.mean(found[name]):.2f}" if found[name] else "undefined" for name in names]
            lines.append([row, *means, str(min(len(values) for values in found.values()))])
    show(lines)
    return numbers


def latency(options: Options) -> Numbers:
    """Wall milliseconds a frame inside the fuser alone and inside the whole pipeline, one thread."""
    lines = [["system", "fuser ms", "95 %", "worst", "pipeline ms"]]
    numbers: Numbers = {}
    with Bench(options) as bench:
        for row in options.rows or FUSED:
            try:
                composed = bench.trained(row, _DRIVE)
                pipeline = build_pipeline(composed.config, composed.choices)
            except VioframeError as error:
                lines.append([row, str(error), "", "", ""])
                continue
            spent: list[float] = []
            update = pipeline.fuser.update

            def timed(measurement: Measurement, update=update, spent=spent) -> list[NavState]:
                started = time.perf_counter()
                states = update(measurement)
                spent.append(1e3 * (time.perf_counter() - started))
                return states

            pipeline.fuser.update = timed  # type: ignore[method-assign]
            _, entry = play(composed.config, composed.choices, pipeline)
            # The first windows fill caches and load nets.
            steady = np.array(spent[20:])
            told = [float(steady.mean()), float(np.percentile(steady, 95)), float(steady.max())]
            whole = entry["ms_per_frame"]
            told.append(float(whole["total"]) if isinstance(whole, dict) else float("nan"))
            numbers[row] = told
            lines.append([row, *(f"{value:.2f}" for value in told)])
    show(lines)
    return numbers
