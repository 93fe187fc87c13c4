"""How fast learned odometry is, and what share of the machine's own speed that is."""

import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from playing import compose_config
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from vioframe.build import build_pipeline
from vioframe.conventions import NANOSECONDS
from vioframe.data.windows import StoredSequence, cut_window
from vioframe.geometry import se3
from vioframe.interfaces import Trainable
from vioframe.learning.batch import WindowBatch, collate
from vioframe.learning.figures import model_figures
from vioframe.learning.training import Split, train_parts
from vioframe.pipeline import Pipeline
from vioframe.tasks.fitting import trainable_parts, trainer_options
from vioframe.tracking import NullTracker
from vioframe.types import Camera, Frame, ImuNoise, SensorRig, Trajectory, VisualFeatures

PRECISIONS = ("32", "bf16", "16")
_DTYPES = {"32": torch.float32, "bf16": torch.bfloat16, "16": torch.float16}
_STEP_NS = 100_000_000
_ROTATION = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

Numbers = dict[str, object]


def throughput(
    overrides: Sequence[str],
    *,
    batch: int | None,
    precision: str | None,
    image: tuple[int, int],
    seconds: float,
    small: bool,
    training: bool,
) -> Numbers:
    """Measure, print and return all of it."""
    gpu = torch.cuda.is_available()
    batch = batch or (64 if gpu else 4)
    precision = precision or ("bf16" if gpu else "32")
    device = torch.device("cuda" if gpu else "cpu")
    if gpu:
        torch.set_float32_matmul_precision("high")
        torch.backends.cudnn.benchmark = True
    chosen = [
        "vo=tsvo",
        "frontend=tvnet",
        "fuser=vo_only",
        "integrator=none",
        f"trainer={'cpu' if small else 'default'}",
    ]
    if any(text.startswith("vo=") and text != "vo=tsvo" for text in overrides):
        chosen = [text for text in chosen if not text.startswith(("vo=", "frontend="))]
    config = compose_config(*chosen, *overrides)
    pipeline = build_pipeline(config, {})
    size_px = tuple(config.trainer.size_px)
    machine = torch.cuda.get_device_name() if gpu else f"{torch.get_num_threads()} thread(s) of a CPU"
    print(
        f"{' '.join([*chosen, *overrides])}\n{machine}, torch {torch.__version__}, net at {size_px[0]}×{size_px[1]} px"
    )
    figures = model_figures(pipeline.parts(), size_px)
    if "vo.parameters" not in figures:
        raise SystemExit("there is no net in the slot vo: choose one, as --set vo=deepvo")
    gmac = figures.get("vo.gmac", float("nan"))
    print(f"size: {figures['vo.parameters'] / 1e6:.2f} M parameters, {gmac:.3f} GMAC an image")
    peak = _peak_tflops(device, _DTYPES[precision])
    copy = _copy_gb_s(device)
    print(f"machine: {peak:.3g} TFLOP/s in a matrix product at {precision}, {copy:.3g} GB/s copied (read and written)")
    numbers: Numbers = {"machine": machine, "peak_tflops": peak, "copy_gb_s": copy, **figures}
    # No weights: speed does not depend on them.
    numbers["streaming"] = _streaming(pipeline, image, seconds)
    numbers["batched"] = _batched(pipeline, config, batch, precision, device, seconds, gmac, peak, copy)
    if training:
        numbers["training"] = _training(config, gpu)
    return numbers


def _streaming(pipeline: Pipeline, image: tuple[int, int], seconds: float) -> Numbers:
    """Image by image, from the camera's bytes to a motion, as in ``python -m vioframe``."""
    rig = _rig(image)
    for part in pipeline.parts().values():
        part.setup(rig)
    frames = [Frame(stamp_ns=_STEP_NS * k, images=(each,)) for k, each in enumerate(_noise(16, image))]
    spent: dict[str, list[float]] = {"flow": [], "net": [], "all": []}
    before: VisualFeatures | None = None
    begin = time.perf_counter()
    number = 0
    while time.perf_counter() - begin < seconds or number < 4 + 8:
        frame = Frame(stamp_ns=_STEP_NS * number, images=frames[number % len(frames)].images)
        start = time.perf_counter()
        # Answers come back to the CPU, which waits for the GPU.
        features = VisualFeatures(frame=frame) if pipeline.frontend is None else pipeline.frontend.process(frame)
        middle = time.perf_counter()
        if before is not None and pipeline.vo is not None:
            pipeline.vo.estimate(before, features)
        end = time.perf_counter()
        before = features
        number += 1
        if number > 4:
            spent["flow"].append(1e3 * (middle - start))
            spent["net"].append(1e3 * (end - middle))
            spent["all"].append(1e3 * (end - start))
    flow, net, both = (median(spent[name]) for name in ("flow", "net", "all"))
    print(
        f"image by image ({image[0]}×{image[1]} px, 32 bit): {1e3 / both:.1f} frames/s; flow {flow:.2f} ms, "
        f"net {net:.2f} ms, median of {len(spent['all'])}"
    )
    return {"frames_per_s": 1e3 / both, "flow_ms": flow, "net_ms": net}


def _batched(
    pipeline: Pipeline,
    config: DictConfig,
    batch: int,
    precision: str,
    device: torch.device,
    seconds: float,
    gmac: float,
    peak: float,
    copy: float,
) -> Numbers:
    """One window that is answered ``batch`` times, from bytes on the CPU to motions on the CPU."""
    parts = {slot: part for slot, part in pipeline.parts().items() if isinstance(part, Trainable)}
    vo = parts["vo"]
    for part in parts.values():
        part.net.to(device).eval()
    if device.type == "cuda":
        # As training has them.
        vo.net.to(memory_format=torch.channels_last)
    pairs = batch + vo.context_pairs - 1
    stored = _sequence("noise", pairs + 1, config)
    window = collate([cut_window(stored, 0, pairs)])
    window = window.pin_memory() if device.type == "cuda" else window

    def bring() -> WindowBatch:
        return window.to(device, non_blocking=True).as_float()

    def flow(there: WindowBatch) -> dict[str, Tensor]:
        known: dict[str, Tensor] = {}
        for slot, part in parts.items():
            if slot != "vo":
                known |= part.forward_batch(there, known)
        return known

    def net(there: WindowBatch, known: Mapping[str, Tensor]) -> Tensor:
        lowered = nullcontext() if precision == "32" else torch.autocast(device.type, _DTYPES[precision])
        with lowered:
            return vo.forward_batch(there, known)["T_prev_cur"]

    with torch.inference_mode():
        there = bring()
        known = flow(there)
        flow_s = _time(lambda: flow(there), device, seconds)
        net_s = _time(lambda: net(there, known), device, seconds)

        def whole() -> Tensor:
            moved = bring()
            return net(moved, flow(moved)).cpu()

        whole_s = _time(whole, device, seconds)
        answered = whole().shape[1]
        solver = any(True for slot, part in parts.items() if slot != "vo" for _ in part.net.parameters())
        with _Traffic() as traffic:
            flow(there)
    share = 2e-3 * gmac * answered / net_s / peak
    print(
        f"{answered} at once ({pairs} flows, net at {precision}): {answered / whole_s:.1f} frames/s; flow "
        f"{1e3 * flow_s / pairs:.2f} ms, net {1e3 * net_s / answered:.2f} ms a frame\n"
        f"  net: {2e-3 * gmac * answered / net_s:.3g} TFLOP/s, {100 * share:.1f} % of the matrix product"
    )
    numbers: Numbers = {
        "batch": answered,
        "precision": precision,
        "frames_per_s": answered / whole_s,
        "flow_ms": 1e3 * flow_s / pairs,
        "net_ms": 1e3 * net_s / answered,
        "net_share_of_peak": share,
    }
    if solver:
        speed = 1e-9 * traffic.bytes / flow_s
        print(f"  flow: {speed:.3g} GB/s read and written by its steps, {100 * speed / copy:.1f} % of a copy")
        numbers["flow_share_of_copy"] = speed / copy
    return numbers


def _training(config: DictConfig, gpu: bool) -> Numbers:
    """The loop of ``task=train`` itself, on recordings of noise: loading, augmentation, both passes, the step."""
    config = config.copy()
    steps = 40 if gpu else 2
    config.trainer.update(
        {"max_epochs": 3 if gpu else 2, "epoch_windows": steps * config.trainer.batch_size, "max_minutes": None}
    )
    config.trainer.update({"validate_every": 100, "segment_lengths_m": [2.0], "top_k": 1})
    # An unrolled solver works as it is, and teaching it takes longer than all the rest.
    config.trainer.train = config.trainer.train or ["vo"]
    options = trainer_options(config, {})
    parts = trainable_parts(config, {}, options.seed)
    context = max(part.context_pairs for part in parts.values())
    splits = [
        Split(sequences=(_sequence(name, count, config),), hashes=(name,))
        for name, count in (("training", context + (400 if gpu else 30)), ("validation", context + 6))
    ]
    with tempfile.TemporaryDirectory() as folder, _utilisation(gpu) as used:
        trained = train_parts(
            parts, splits[0], splits[1], options, folder=Path(folder), tracker=NullTracker(), about={}, shown=False
        )
    speed = trained.curve[-1]["images_per_s"]
    told = f", GPU busy {median(used[len(used) // 2 :]):.0f} % of the time" if used else ""
    print(
        f"training, batches of {options.batch_size} windows at {options.precision}: {speed:.1f} images/s{told} "
        f"(last epoch, {steps} steps; trains {' and '.join(options.train or ())}; a window has {context + 1} images)"
    )
    return {"images_per_s": speed, "gpu_busy_percent": median(used[len(used) // 2 :]) if used else None}


@contextmanager
def _utilisation(gpu: bool) -> Iterator[list[float]]:
    """What nvidia-smi says five times a second while the block runs; nothing without a GPU."""
    values: list[float] = []
    if not gpu:
        yield values
        return
    command = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", "-lms", "200"]
    with tempfile.TemporaryFile("w+") as written:
        process = subprocess.Popen(command, stdout=written)
        try:
            yield values
        finally:
            process.terminate()
            process.wait()
            written.seek(0)
            values += [float(line) for line in written if line.strip().isdigit()]


class _Traffic(TorchDispatchMode):
    """Counts the bytes of what each step reads and writes; views are free."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        returned = func._schema.returns
        if not any(each.alias_info is not None and not each.alias_info.is_write for each in returned):
            tensors = [*_tensors(args), *_tensors(tuple((kwargs or {}).values())), *_tensors((result,))]
            self.bytes += sum(tensor.numel() * tensor.element_size() for tensor in tensors)
        return result


def _tensors(values: Any) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (tuple, list)):
            yield from _tensors(value)


def _time(call: Callable[[], object], device: torch.device, seconds: float) -> float:
    """Median seconds of a call, after three that do not count."""
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < 6 or (time.perf_counter() - begin < seconds and len(times) < 200):
        if device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return median(times[3:])


def _peak_tflops(device: torch.device, dtype: torch.dtype) -> float:
    side = 8192 if device.type == "cuda" else 1024
    first, second = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    return 2e-12 * side**3 / _time(lambda: first @ second, device, 1.0)


def _copy_gb_s(device: torch.device) -> float:
    source = torch.empty(2**28 if device.type == "cuda" else 2**25, dtype=torch.float32, device=device).zero_()
    target = torch.empty_like(source)
    return 2e-9 * 4 * source.numel() / _time(lambda: target.copy_(source), device, 1.0)


def _rig(image: tuple[int, int]) -> SensorRig:
    noise = ImuNoise(gyro_noise=1.7e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=100.0)
    return SensorRig(cameras=(_camera(image),), imu=noise)


def _camera(image: tuple[int, int]) -> Camera:
    width, height = image
    return Camera(
        model="pinhole",
        intrinsics_px=np.array([0.58 * width, 0.58 * width, 0.5 * (width - 1), 0.5 * (height - 1)]),
        size_px=image,
        T_body_cam=se3.from_parts(_ROTATION, np.zeros(3)),
    )


def _noise(count: int, size: tuple[int, int]) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [random.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8) for _ in range(count)]


def _sequence(name: str, images: int, config: DictConfig) -> StoredSequence:
    """A straight drive through noise, a metre an image."""
    size = (int(config.trainer.size_px[0]), int(config.trainer.size_px[1]))
    shown = np.stack(_noise(min(images, 40), size))[np.arange(images) % min(images, 40)]
    poses = np.tile(np.eye(4), (images, 1, 1))
    poses[:, 2, 3] = np.arange(images)
    stamps = _STEP_NS * np.arange(images, dtype=np.int64)
    camera = _camera(size)
    velocity = np.zeros((images, 3))
    velocity[:, 2] = NANOSECONDS / _STEP_NS
    return StoredSequence(
        name=name,
        images=shown[..., : int(config.trainer.channels)],
        stamps_ns=stamps,
        T_world_cam=poses,
        known=np.ones(images, dtype=np.bool_),
        imu=None,
        camera=camera,
        gravity=9.81,
        truth=Trajectory(stamps_ns=stamps, T_world_body=poses @ se3.inverse(camera.T_body_cam), v_world_body=velocity),
    )
