"""Flow against the exact flow of simulated images, and against another implementation of TV-L1."""

from importlib.util import find_spec

import numpy as np
import pytest

from vioframe.data.simulator import CameraSettings, SimulatedDataset
from vioframe.types import Frame
from vioframe_flow import DisFrontend, TvnetFrontend

HAS_TORCH = find_spec("torch") is not None and find_spec("safetensors") is not None
needs_torch = pytest.mark.skipif(not HAS_TORCH, reason="torch is not installed (pip install 'vioframe[learn]')")
SIZE = (256, 128)


@pytest.fixture(scope="module")
def scenes() -> list:
    """Rig, pair of frames, exact flow and what of it is seen, of a car and of a walk."""
    found = []
    for family, apart in (("car", 1), ("walk", 2)):
        settings = CameraSettings(size_px=SIZE)
        dataset = SimulatedDataset(sequence=family, seed=1, duration_s=14.0, camera=settings)
        recording = dataset.open(dataset.sequences[0])
        stamps = recording.frame_stamps_ns
        for share in (0.6, 0.9):
            k = int(share * len(stamps))
            pair = [int(stamps[k]), int(stamps[k + apart])]
            frames = [
                Frame(stamp_ns=stamp, images=recording.imager.images(float(recording.elapsed_s(stamp))))
                for stamp in pair
            ]
            found.append((recording.rig, frames, *recording.exact_flow(*pair)))
    return found


def errors_of(flow: np.ndarray, truth: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.linalg.norm(flow - truth, axis=-1)[seen]


def run(frontend, rig, frames) -> np.ndarray:
    frontend.setup(rig)
    return frontend.process_many(frames)[1].flow


@pytest.mark.parametrize(
    ("make", "median_px"),
    [
        pytest.param(lambda: DisFrontend(), 0.6, id="dis"),
        pytest.param(lambda: TvnetFrontend(size_px=None, device="cpu"), 0.6, id="tvnet", marks=needs_torch),
    ],
)
def test_defaults_find_the_exact_flow(make, median_px: float, scenes) -> None:
    for rig, frames, truth, seen in scenes:
        assert np.median(np.linalg.norm(truth[seen], axis=-1)) > 1.0
        errors = errors_of(run(make(), rig, frames), truth, seen)
        assert np.median(errors) < median_px
        # Standing still would be wrong by the length of the flow.
        assert errors.mean() < 0.4 * np.linalg.norm(truth[seen], axis=-1).mean()


@needs_torch
def test_not_worse_than_scikit_image_with_equal_settings(scenes) -> None:
    registration = pytest.importorskip("skimage.registration", reason="scikit-image is not installed")
    ours, theirs = [], []
    for rig, frames, truth, seen in scenes:
        frontend = TvnetFrontend(
            size_px=None,
            device="cpu",
            quantise=False,
            warps=5,
            iterations=5,
            coupling=0.3,
            smoothing_px=0.0,
            trust_outside=True,
        )
        ours.append(errors_of(run(frontend, rig, frames), truth, seen).mean())
        theirs.append(errors_of(scikit_flow(registration, frames, 0.3, 5, 5), truth, seen).mean())
    assert np.mean(ours) <= np.mean(theirs)


@needs_torch
def test_agrees_with_scikit_image_where_both_are_smooth(scenes) -> None:
    """In the limit of a tight coupling: theirs takes the first of its two dual steps from v, where TV-L1 has u,
    which leaves a difference of the order of θ."""
    registration = pytest.importorskip("skimage.registration", reason="scikit-image is not installed")
    cv2 = pytest.importorskip("cv2")
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    gaps = {}
    for coupling in (0.3, 0.05):
        gaps[coupling] = []
        for rig, frames, *_ in scenes[:1]:
            # A known gentle motion of a simulated image, so that both find it.
            first = frames[0].images[0]
            moved = columns - 1.2 * np.sin(rows / 30.0) - 0.3, rows - 0.8 * np.cos(columns / 40.0)
            pair = [frames[0], Frame(stamp_ns=2, images=(cv2.remap(first, *moved, cv2.INTER_CUBIC),))]
            frontend = TvnetFrontend(
                size_px=None, device="cpu", quantise=False, warps=10, iterations=20, coupling=coupling, smoothing_px=0.0
            )
            flows = [run(frontend, rig, pair), scikit_flow(registration, pair, coupling, 10, 20)]
            steep = np.max([np.abs(np.gradient(flow, axis=(0, 1))).max(axis=(0, 3)) for flow in flows], axis=0)
            smooth = steep < 0.05
            assert smooth.mean() > 0.3
            gaps[coupling].append(np.median(np.linalg.norm(flows[0] - flows[1], axis=-1)[smooth]))
    assert max(gaps[0.05]) < 0.05
    assert np.mean(gaps[0.05]) < np.mean(gaps[0.3])


def scikit_flow(registration, frames, tightness: float, warps: int, iterations: int) -> np.ndarray:
    """Flow (H, W, 2) by scikit-image, whose images span 0 … 1: λ there is 255 times λ here."""
    images = np.stack([frame.images[0] for frame in frames]).astype(np.float32)
    images = (images - images.min()) / np.ptp(images)
    rows, columns = registration.optical_flow_tvl1(
        *images, attachment=255 * 0.15, tightness=tightness, num_warp=warps, num_iter=iterations, tol=0.0
    )
    return np.stack([columns, rows], axis=-1)
