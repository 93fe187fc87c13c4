"""Iterations a second of SuperPoint's joint training with each loss of the descriptors, side by side in one run.

    python benchmarks/superpoint_losses.py
    python benchmarks/superpoint_losses.py --encoders vgg --size 160 120 --rounds 5

Encoders and losses take turns on the same batch, so that what else the machine does slows all of them. On a CPU it
keeps to one thread, whose own time is counted. An iteration is forward, backward and a step of Adam, as in training;
"loss alone" is the part from raw descriptors to their gradient. What draws the pairs is told apart.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

import numpy as np
import torch

from vioframe.pictures import HomographyOptions, LightingOptions, Textures
from vioframe_superpoint.net.superpoint import make_net
from vioframe_superpoint.training import DenseLoss, DescriptorLoss, PairOptions, SparseHingeLoss, SparseTripletLoss
from vioframe_superpoint.training.losses import descriptor_loss
from vioframe_superpoint.training.pairs import make_pair, stack_pairs
from vioframe_superpoint.training.precision import autocast, resolve_precision
from vioframe_superpoint.training.steps import JointLoss

LOSSES: dict[str, DescriptorLoss] = {
    "dense": DenseLoss(weight=1.0, positive_margin=1.0, negative_margin=0.2, positive_weight=250.0, radius_px=8.0),
    "sparse_hinge": SparseHingeLoss(
        weight=1.0, positive_margin=1.0, negative_margin=0.2, positive_weight=1.0, negatives=100, radius_px=8.0
    ),
    "sparse_triplet": SparseTripletLoss(weight=1.2, margin=1.0, negatives=16, radius_px=8.0, both_ways=True),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encoders", nargs="+", default=["mobilenetv2", "ghostnet", "vgg"])
    parser.add_argument("--size", nargs=2, type=int, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--batch", type=int, default=8, help="pairs")
    parser.add_argument("--matches", type=int, default=256, help="of a pair, for the sparse losses")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--precision", default="auto", choices=("auto", "32", "bf16"))
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    if device.type == "cpu":
        torch.set_num_threads(1)
    precision = resolve_precision(arguments.precision, device)
    clock = time.process_time if device.type == "cpu" else time.perf_counter

    began = clock()
    batch = {name: value.to(device) for name, value in _batch(tuple(arguments.size), arguments).items()}
    print(f"pairs: {(clock() - began) / arguments.batch * 1e3:.1f} ms each; precision {precision}, {device.type}")
    steps: dict[tuple[str, str], Callable[[], None]] = {}
    for encoder in arguments.encoders:
        for name, options in LOSSES.items():
            steps[encoder, name] = _step(encoder, options, batch, device, precision)
    for name, options in LOSSES.items():
        steps["", name] = _alone(options, batch, tuple(arguments.size), device, precision)
    seconds: dict[tuple[str, str], list[float]] = {key: [] for key in steps}
    for number in range(arguments.rounds + 1):
        for key, step in steps.items():
            began = clock()
            step()
            if device.type == "cuda":
                torch.cuda.synchronize()
            # The first time memory is found.
            if number:
                seconds[key].append(clock() - began)
    print(f"{'encoder':14s}" + "".join(f"{name + ' it/s':>22s}" for name in LOSSES) + f"{'triplet : dense':>18s}")
    for encoder in (*arguments.encoders, ""):
        rates = [1.0 / median(seconds[encoder, name]) for name in LOSSES]
        told = "".join(f"{rate:22.3f}" for rate in rates)
        print(f"{encoder or 'loss alone':14s}{told}{rates[2] / rates[0]:18.2f}")


def _batch(size_px: tuple[int, int], arguments: argparse.Namespace) -> dict[str, torch.Tensor]:
    options = PairOptions(
        size_px=size_px,
        scale=[0.8, 1.2],
        homographies=HomographyOptions(max_angle=0.8),
        lighting=LightingOptions(),
        matches=arguments.matches,
        labelled=0.5,
    )
    textures = Textures(size_px=size_px, count=arguments.batch)
    pairs = []
    for index in range(arguments.batch):
        rng = np.random.default_rng(index)
        labels = rng.uniform(0.0, np.array(size_px) - 1.0, (300, 2))
        pairs.append(make_pair(textures.picture(index), labels, rng, options))
    return {name: torch.from_numpy(value) for name, value in stack_pairs(pairs).items()}


def _step(
    encoder: str, options: DescriptorLoss, batch: dict[str, torch.Tensor], device: torch.device, precision: str
) -> Callable[[], None]:
    torch.manual_seed(0)
    net = make_net(encoder).to(device).train()
    for parameter in net.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-3)
    loss = JointLoss(options)

    def step() -> None:
        with autocast(device, precision):
            losses = loss(net, batch, 0)
        losses["loss"].backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    return step


def _alone(
    options: DescriptorLoss,
    batch: dict[str, torch.Tensor],
    size_px: tuple[int, int],
    device: torch.device,
    precision: str,
) -> Callable[[], None]:
    pairs = batch["H"].shape[0]
    shape = (pairs, 256, size_px[1] // 8, size_px[0] // 8)
    generator = torch.Generator().manual_seed(0)
    maps = [torch.randn(shape, generator=generator).to(device).requires_grad_() for _ in range(2)]
    points, overlap = batch["points"], batch["overlap"]

    def step() -> None:
        with autocast(device, precision):
            loss = descriptor_loss(
                options,
                *maps,
                batch["H"],
                points=(points[:, 0], points[:, 1]),
                matched=batch["matched"],
                valid=(overlap[:, 0], overlap[:, 1]),
                seed=0,
            )
        loss.backward()

    return step


if __name__ == "__main__":
    main()
