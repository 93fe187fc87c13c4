"""A short, exact scene as training has it, for tests of windows, batches and the loop."""

import numpy as np

from vioframe.data.recording import Dataset, Recording
from vioframe.data.simulated_vo import SimulatedVO
from vioframe.data.windows import StoredSequence
from vioframe.testing import Scene, make_scene


def stored(scene: Scene | None = None, name: str = "scene") -> StoredSequence:
    """The conformance scene, decoded."""
    scene = scene or make_scene()
    camera = scene.rig.cameras[0]
    return StoredSequence(
        name=name,
        images=np.stack([frame.images[0] for frame in scene.frames])[..., None],
        stamps_ns=scene.truth.stamps_ns,
        T_world_cam=scene.truth.T_world_body @ camera.T_body_cam,
        known=np.ones(len(scene.truth), dtype=np.bool_),
        imu=scene.imu,
        camera=camera,
        gravity=scene.rig.gravity,
        truth=scene.truth,
    )


class SceneRecording(Recording):
    """The conformance scene as a recording; some frames may be changed or left out."""

    def __init__(self, name: str = "scene", frames: int | None = None, change=lambda index, frame: frame):
        self.name = name
        self.scene = make_scene()
        self.frames = [change(i, frame) for i, frame in enumerate(self.scene.frames[:frames])]
        self.streamed = 0

    @property
    def rig(self):
        return self.scene.rig

    def packets(self):
        yield self.scene.imu
        for frame in self.frames:
            self.streamed += 1
            yield frame

    @property
    def frame_count(self):
        return len(self.frames)

    @property
    def duration_s(self):
        return (self.frames[-1].stamp_ns - self.frames[0].stamp_ns) / 1e9

    def ground_truth(self):
        return self.scene.truth


class SceneDataset(Dataset):
    """Some recordings by name."""

    def __init__(self, recordings):
        self.recordings = {recording.name: recording for recording in recordings}

    @property
    def sequences(self):
        return list(self.recordings)

    def open(self, sequence):
        return self.recordings[sequence]


class Truthful(SimulatedVO):
    """Answers the truth, whatever its weights are."""

    def __init__(self, *, weights: str) -> None:
        super().__init__(rotation_noise=0.0, translation_noise=0.0)
