"""A small part with a net, and options to train it quickly."""

import torch
from torch import nn

from vioframe.data.augmentation import Augmentation
from vioframe.interfaces import METRIC_SCALE, RELATIVE_POSE, VOEstimator
from vioframe.learning.options import TrainerOptions
from vioframe.types import RelativePose

STILL = {
    "reverse": 0.0,
    "mirror": 0.0,
    "blur": 0.0,
    "blur_sigma_px": [0.5, 1.0],
    "salt_pepper": 0.0,
    "salt_pepper_share": 0.01,
    "photometric": 0.0,
    "brightness": 0.1,
    "contrast": 0.1,
    "gamma": 0.1,
}


def options(folder, **changes) -> TrainerOptions:
    """Options that train the conformance scene in a second or two."""
    augmentation = Augmentation(**{**STILL, **changes.pop("augmentation", {})})
    plain = {
        "seed": 0,
        "max_epochs": 3,
        "epoch_windows": None,
        "max_minutes": None,
        "batch_size": 4,
        "pairs": None,
        "size_px": [64, 48],
        "flow_size_px": None,
        "width": 1.0,
        "dropout": 0.0,
        "channels": 1,
        "recordings": None,
        "cache": str(folder / "cache"),
        "train": None,
        "optimizer": "adamw",
        "learning_rate": 3e-3,
        "weight_decay": 1e-3,
        "schedule": "constant",
        "halve_every": 25,
        "warmup_steps": 0,
        "gradient_clip": 10.0,
        "divergence_factor": 5.0,
        "top_k": 2,
        "validate_every": 1,
        "segment_lengths_m": [0.2],
        "segment_step": 1,
        "accelerator": "cpu",
        "devices": 1,
        "precision": "32",
        "workers": 0,
        "resume": None,
        "fusion": {},
        "settling": {},
    }
    return TrainerOptions(**{**plain, **changes}, augmentation=augmentation)


class TinyVo(VOEstimator):
    """Two images in, translation and small rotation out; dropout on purpose, to see that resuming repeats it."""

    provides = frozenset({RELATIVE_POSE, METRIC_SCALE})
    needs_training = False

    def __init__(self, width: int = 8, context: int = 1, dropout: float = 0.2, motion: bool = True) -> None:
        self._context = context
        self._width = width
        self._motion = motion
        self.net = nn.Sequential(
            nn.Conv2d(2 * context, width, 5, 4, 2),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, 2, 1),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d((6, 8)),
            nn.Flatten(),
            nn.Dropout(dropout),
            nn.Linear(48 * width, 6),
        )

    @property
    def context_pairs(self):
        return self._context

    @property
    def architecture(self):
        return {"part": "tiny", "width": self._width, "context": self._context}

    def forward_batch(self, batch, upstream):
        # The scene is bright dots on grey of 60.
        grey = 4.0 * (batch.images.mean(dim=2) - 60 / 255)
        stacks = [
            torch.cat([grey[:, k : k + self._context], grey[:, k + 1 : k + 1 + self._context]], dim=1)
            for k in range(batch.pairs - self._context + 1)
        ]
        tangent = 0.1 * self.net(torch.stack(stacks, dim=1).flatten(0, 1)).unflatten(0, (len(batch), -1))
        outputs = {"tangent": tangent}
        if self._motion:
            outputs["T_prev_cur"] = motion_of(tangent)
        return outputs

    def loss(self, outputs, batch):
        T = batch.T_prev_cur[:, -outputs["tangent"].shape[1] :]
        skew = 0.5 * (T[..., :3, :3] - T[..., :3, :3].transpose(-1, -2))
        truth = torch.cat([torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1), T[..., :3, 3]], -1)
        squared = 1e3 * (outputs["tangent"] - truth).square().mean()
        return {"loss": squared, "worst": squared.detach()}

    def estimate(self, previous, current):
        return RelativePose.invalid()


def motion_of(tangent):
    """Motions (..., 4, 4) of (rotation vector, translation)."""
    zero = torch.zeros_like(tangent[..., 0])
    x, y, z = tangent[..., 0], tangent[..., 1], tangent[..., 2]
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    T = torch.zeros((*tangent.shape[:-1], 4, 4), dtype=tangent.dtype)
    T[..., :3, :3] = torch.linalg.matrix_exp(skew)
    T[..., :3, 3] = tangent[..., 3:]
    T[..., 3, 3] = 1.0
    return T
