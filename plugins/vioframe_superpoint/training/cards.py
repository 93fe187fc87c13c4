"""What the cards of weights and of labels tell."""

import platform
from collections.abc import Mapping
from typing import Any

import torch

GENERATED = "Apache-2.0; learned from generated pictures alone"
"""Licence of weights that learned from nothing else."""


def machine_of(device: torch.device) -> dict[str, object]:
    """Where it was trained."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    return {"device": device.type, "name": name, "threads": torch.get_num_threads()}


def excerpt_of(card: Mapping[str, object]) -> dict[str, object]:
    """What labels should tell of the detector that made them."""
    return {name: card[name] for name in ("iteration", "hours", "validation", "training", "seed") if name in card}


def made_with(labels: Mapping[str, Any]) -> dict[str, object]:
    """What labels were made with, which the options of a training that only reads them need not say."""
    made = {name: labels[name] for name in ("pictures", "adaptation")}
    return {**made, "shapes": labels.get("detector", {}).get("training")}


def licence_of(labels: Mapping[str, Any]) -> str:
    """Under what terms weights are that learned from labelled pictures, by what the labels tell."""
    folder = labels["pictures"].get("folder")
    return GENERATED if folder is None else f"what the pictures of {folder}, from which it learned, allow"
