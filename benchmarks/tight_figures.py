"""What ``benchmarks/tight.py`` measures: a function a figure."""

import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from playing import DrawnRecording, Played, draw, open_recording, play

from vioframe.checks import Array
from vioframe.data.faults import Faults, FaultyRecording
from vioframe.data.recording import Recording
from vioframe.errors import MetricError
from vioframe.evaluation.align import align_first, associate
from vioframe.geometry import so3
from vioframe.types import SensorRig, Trajectory

SEQUENCES = ("V1_01_easy", "V1_02_medium", "V2_01_easy", "MH_01_easy", "MH_04_difficult")
CAMERAS = {"mono": 1, "stereo": 2}
Entry = dict[str, object]


@dataclass(frozen=True)
class Options:
    """The command line.

    Attributes:
        root: folder of the recordings.
        sequences: of them.
        seeds: of what is drawn.
        fusers: names of the back ends.
        rigs: ``mono`` and ``stereo``.
        more: further overrides of every system.
        seconds: length; None for what the figure asks for.
        runs: simulated runs of the consistency.
        scratch: where drawn images are kept, or None.
    """

    root: str
    sequences: tuple[str, ...]
    seeds: tuple[int, ...]
    fusers: tuple[str, ...]
    rigs: tuple[str, ...]
    more: tuple[str, ...]
    seconds: float | None
    runs: int
    scratch: Path | None

    def systems(self) -> Iterator[tuple[str, str, list[str]]]:
        """Fuser, rig and overrides of each system."""
        for fuser in self.fusers:
            for rig in self.rigs:
                yield fuser, rig, [f"fuser={fuser}", f"rig={rig}", *self.more]

    def folder(self) -> str:
        """The root, which must be given."""
        if not self.root:
            sys.exit("--root is missing: the folder of the recordings")
        return self.root

    def replay(self, sequence: str, seed: int) -> list[str]:
        """Overrides of a replayed sequence."""
        source = [f"dataset.source.root={self.folder()}", f"dataset.source.sequence={sequence}"]
        length = [] if self.seconds is None else [f"dataset.duration_s={self.seconds}"]
        return ["dataset=replay", *source, f"dataset.seed={seed}", *length]

    def simulated(self, family: str, seed: int, seconds: float) -> list[str]:
        """Overrides of a simulated sequence, ``seconds`` long unless the command line says otherwise."""
        length = seconds if self.seconds is None else self.seconds
        return [f"dataset.sequence={family}", f"dataset.seed={seed}", f"dataset.duration_s={length}"]

    @contextmanager
    def drawn(self, overrides: list[str]) -> Iterator[Callable[[str], Recording]]:
        """Draw a recording with as many cameras as any rig needs; gives it as one of them sees it."""
        rig = "stereo" if "stereo" in self.rigs else "mono"
        with tempfile.TemporaryDirectory() as temporary:
            path = draw(self.scratch or Path(temporary), *overrides, f"rig={rig}")
            yield lambda name: DrawnRecording(path, CAMERAS[name])


def entry(fuser: str, rig: str, sequence: str, seed: int, played: Played) -> Entry:
    """What every figure tells of a run."""
    row = played.row
    protocol = row["protocol"]
    return {
        "fuser": fuser,
        "rig": rig,
        "sequence": sequence,
        "seed": seed,
        "ATE m": played.ate_m,
        "ATE %": row["ate_se3_percent"],
        "completion %": 100.0 * float(str(row["completion"] or 0.0)),
        "started s": played.started_s,
        "lost": sum(state.status == "lost" for state in played.states),
        **{f"{name} ms": value for name, value in played.cpu().items()},
        "ANEES pos": row["anees_position"],
        "ANEES ori": row["anees_orientation"],
        "path m": row["path_m"],
        "max error m": row["ate_se3_max_m"],
        "faults": protocol["faults"] if isinstance(protocol, dict) else [],
        "counters": row["counters"],
    }


def tell(row: Entry, *columns: str) -> None:
    """One line while it lasts."""
    values = "  ".join(f"{name} {shown(row[name])}" for name in columns if name in row)
    print(f"{row['fuser']:8} {row['rig']:6} {row['sequence']!s:16} {row['seed']}  {values}", flush=True)


def shown(value: object) -> str:
    """A cell of a table."""
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"
    return "" if value is None else str(value)


def table(rows: list[Entry], columns: tuple[str, ...] = ()) -> None:
    """Print rows below each other; the columns of all where none are chosen."""
    names = list(columns or dict.fromkeys(key for row in rows for key in row))
    cells = [names, *([shown(row.get(name)) for name in names] for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(names))]
    print()
    for line in cells:
        print("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())


def accuracy(options: Options) -> list[Entry]:
    """Causal SE(3) error on every replay, seed, back end and rig."""
    entries = []
    for sequence in options.sequences:
        for seed in options.seeds:
            with options.drawn(options.replay(sequence, seed)) as view:
                for fuser, rig, system in options.systems():
                    entries.append(entry(fuser, rig, sequence, seed, play(view(rig), system)))
                    tell(entries[-1], "ATE m", "completion %", "total ms", "total p95 ms", "counters")
    table(summarise(entries))
    return entries


def summarise(entries: list[Entry]) -> list[Entry]:
    """The median over seeds for each sequence, and the mean of these over the rooms."""
    rows: list[Entry] = []
    for fuser, rig in dict.fromkeys((e["fuser"], e["rig"]) for e in entries):
        mine = [e for e in entries if (e["fuser"], e["rig"]) == (fuser, rig)]
        medians = []
        for sequence in dict.fromkeys(e["sequence"] for e in mine):
            runs = [e for e in mine if e["sequence"] == sequence]
            errors = [float(str(e["ATE m"])) for e in runs]
            row: Entry = {"fuser": fuser, "rig": rig, "sequence": sequence, "seeds": len(runs)}
            row |= {"ATE m": float(np.median(errors)), "least": min(errors), "most": max(errors)}
            row["completion %"] = min(float(str(e["completion %"])) for e in runs)
            for key in (key for key in runs[0] if key.endswith(" ms")):
                row[key.removesuffix(" ms")] = float(np.mean([float(str(e[key])) for e in runs if key in e]))
            medians.append(row)
        rows += medians
        for name, start in (("V rooms", "V"), ("MH halls", "MH")):
            some = [float(str(row["ATE m"])) for row in medians if str(row["sequence"]).startswith(start)]
            if some:
                rows.append({"fuser": fuser, "rig": rig, "sequence": f"{name}: mean", "ATE m": float(np.mean(some))})
    return rows


def offset(options: Options) -> list[Entry]:
    """A camera clock that is off: what is recovered, and what it costs."""
    cases = [Faults(time_offset_s=value) for value in (0.0, -0.05, -0.02, -0.005, 0.005, 0.02, 0.05)]

    def judge(played: Played, faults: Faults, aligned: Played, rig: SensorRig) -> Entry:
        injected = 1e3 * faults.time_offset_s
        error, baseline = (_settled_ms(run, rig) - shift for run, shift in ((played, injected), (aligned, 0.0)))
        return {"offset ms": injected, "error ms": error, "against aligned ms": error - baseline}

    return _wrong_calibration(options, cases, judge)


def _settled_ms(played: Played, rig: SensorRig) -> float:
    """The estimated delay, ms beyond that of the rig, over the second half."""
    half = played.delays_ns[len(played.delays_ns) // 2 :]
    return 1e-6 * (float(half.mean()) - rig.camera_delay_ns) if len(half) else float("nan")


def extrinsics(options: Options) -> list[Entry]:
    """A camera turned by 3° against its calibration: what is recovered, and what it costs."""
    turns = ((0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, -3.0, 0.0), (0.0, 0.0, 3.0), (-1.7, 1.7, -1.8))
    cases = [Faults(rotation_deg=turn) for turn in turns]

    def judge(played: Played, faults: Faults, aligned: Played, rig: SensorRig) -> Entry:
        def between(true: Array) -> float:
            return float(np.degrees(so3.angle(true[:3, :3].T @ played.T_body_cam[:3, :3])))

        turned = "[{:g},{:g},{:g}]".format(*faults.rotation_deg)
        true, found = rig.cameras[0].T_body_cam, aligned.T_body_cam
        return {"turned °": turned, "left °": between(true), "against aligned °": between(found)}

    return _wrong_calibration(options, cases, judge)


def _wrong_calibration(
    options: Options, cases: list[Faults], judge: Callable[[Played, Faults, Played, SensorRig], Entry]
) -> list[Entry]:
    """Each fault on simulated walks and, where there is a root, on replays with the recorded IMU."""
    entries = []
    sources = [(f"walk-{seed}", seed, options.simulated("walk", seed, 60.0)) for seed in options.seeds]
    if options.root:
        sources += [(name, seed, options.replay(name, seed)) for name in options.sequences for seed in options.seeds]
    for name, seed, overrides in sources:
        with options.drawn(overrides) as view:
            for fuser, rig, system in options.systems():
                aligned: Played | None = None
                for faults in cases:
                    recording = view(rig)
                    played = play(FaultyRecording(recording, faults), system)
                    aligned = aligned or played
                    judged = judge(played, faults, aligned, recording.rig)
                    judged |= {"ATE / aligned": played.ate_m / aligned.ate_m}
                    entries.append(entry(fuser, rig, name, seed, played) | judged)
                    tell(entries[-1], *judged, "ATE m", "completion %", "counters")
    table(entries, ("fuser", "rig", "sequence", "seed", *judged, "ATE m", "completion %"))
    return entries


def faults(options: Options) -> list[Entry]:
    """A camera-rate run with what cables and drivers do to it."""
    cases = {
        "nothing": Faults(),
        "1 s without camera": Faults(camera_lost_s=[[30.0, 1.0]]),
        "10 % of the frames dropped": Faults(dropped_frames=0.1),
        "0.3 s without IMU": Faults(imu_lost_s=[[30.0, 0.3]]),
        "2 s of blank images": Faults(blank_images_s=[[30.0, 2.0]]),
        "4 s of blank images": Faults(blank_images_s=[[30.0, 4.0]]),
        "5 % of the samples missing": Faults(missing_samples=0.05),
        "stamps off by 2 ms": Faults(stamp_jitter_s=0.002),
    }
    entries = []
    for seed in options.seeds:
        with options.drawn(options.simulated("walk", seed, 60.0)) as view:
            for fuser, rig, system in options.systems():
                for name, fault in cases.items():
                    played = play(FaultyRecording(view(rig), fault), system)
                    entries.append(entry(fuser, rig, f"walk-{seed}", seed, played) | {"fault": name})
                    tell(entries[-1], "fault", "ATE m", "max error m", "completion %", "lost", "ANEES pos", "counters")
    columns = ("fuser", "rig", "seed", "fault", "ATE m", "ATE %", "max error m", "completion %", "lost", "ANEES pos")
    table(entries, (*columns, "counters"))
    return entries


def consistency(options: Options) -> list[Entry]:
    """ANEES per degree of freedom over simulated walks with the real front end on drawn images."""
    entries = []
    for seed in range(options.runs):
        with options.drawn(options.simulated("walk", seed, 46.0)) as view:
            for fuser, rig, system in options.systems():
                entries.append(entry(fuser, rig, f"walk-{seed}", seed, play(view(rig), system)))
                tell(entries[-1], "ATE m", "ANEES pos", "ANEES ori", "completion %")
    rows = []
    for fuser, rig in dict.fromkeys((e["fuser"], e["rig"]) for e in entries):
        mine = [e for e in entries if (e["fuser"], e["rig"]) == (fuser, rig)]
        row: Entry = {"fuser": fuser, "rig": rig, "runs": len(mine)}
        for key in ("ANEES pos", "ANEES ori"):
            values = np.array([float(str(e[key])) for e in mine if e[key] is not None])
            row |= {key: float(values.mean()), f"± of {key}": float(values.std(ddof=1) / np.sqrt(len(values)))}
            row[f"median {key}"] = float(np.median(values))
        row["ATE m"] = float(np.median([float(str(e["ATE m"])) for e in mine]))
        rows.append(row)
    table(rows)
    return entries


def still(options: Options) -> list[Entry]:
    """Real images of a vehicle that stands: how far the pose drifts."""
    entries = []
    for fuser, rig, system in options.systems():
        recording = open_recording("dataset=euroc", f"dataset.root={options.folder()}", f"rig={rig}")
        # The excerpt lasts a second: half of it is gone before a standstill of the usual length has been seen.
        for rest_s in (0.75, 0.3):
            played = play(recording, [*system, f"fuser.start.rest_duration_s={rest_s}"])
            places = np.array([state.T_world_body[:3, 3] for state in played.states]).reshape(-1, 3)
            drift = 1e3 * float(np.linalg.norm(places - places[:1], axis=1).max()) if len(places) else float("nan")
            told: Entry = {"rest s": rest_s, "states": len(places), "drift mm": drift}
            entries.append(entry(fuser, rig, recording.name, 0, played) | told)
    table(entries, ("fuser", "rig", "sequence", "rest s", "states", "drift mm"))
    return entries


def kitti(options: Options) -> list[Entry]:
    """Real images from a car that is already moving, started from the truth and by itself."""
    entries = []
    for sequence in ("06", "01"):
        source = ["dataset=kitti", f"dataset.root={options.folder()}", f"dataset.sequence='{sequence}'"]
        for fuser in options.fusers:
            for init in ("groundtruth", "auto"):
                recording = open_recording(*source, "rig=mono")
                played = play(recording, [f"fuser={fuser}", "rig=mono", *options.more], init)
                attempts = [attempt.sentence for attempt in played.attempts if attempt.sentence]
                said: Entry = {"init": init, "last attempt": attempts[-1] if attempts else ""}
                entries.append(entry(fuser, "mono", sequence, 0, played) | said)
    columns = ("fuser", "sequence", "init", "path m", "ATE m", "ATE %", "completion %", "started s", "last attempt")
    table(entries, columns)
    return entries


def loop(options: Options) -> list[Entry]:
    """Around a building, with and without loop closure: error of the whole, and where it ends."""
    entries = []
    for seed in options.seeds:
        with options.drawn(options.simulated("building", seed, 115.0)) as view:
            for rig in options.rigs:
                for name in ("none", "bow"):
                    played = play(view(rig), ["fuser=window", f"rig={rig}", f"loop={name}", *options.more])
                    final = played.smoothed
                    told: Entry = {
                        "loop": name,
                        "final ATE m": played.final_ate_m,
                        "end error m": _end_error(Trajectory.from_states(played.states), played.truth),
                        "final end error m": float("nan") if final is None else _end_error(final, played.truth),
                    }
                    entries.append(entry("window", rig, f"building-{seed}", seed, played) | told)
                    tell(entries[-1], *told, "ATE m", "total ms", "counters")
    errors = ("path m", "ATE m", "final ATE m", "end error m", "final end error m")
    table(entries, ("rig", "seed", "loop", *errors, "total ms", "total p95 ms", "counters"))
    return entries


def _end_error(estimate: Trajectory, truth: Trajectory | None) -> float:
    """Distance from the truth at the last pose, where yaw and position agree at the first."""
    if truth is None:
        return float("nan")
    try:
        matched = associate(estimate, truth, method="interpolate", max_gap_s=0.11)
    except MetricError:
        return float("nan")
    motion = align_first(matched.T_estimate[0], matched.T_truth[0])
    return float(np.linalg.norm(motion.apply(matched.T_estimate)[-1, :3, 3] - matched.T_truth[-1, :3, 3]))
