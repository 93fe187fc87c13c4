"""What of a part's options has a bearing on what it learns or answers: the words of a cache's key."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

# Where and how fast, not what.
_WITHOUT = ("device", "cache")


def bearing_of(config: DictConfig, slot: str) -> object:
    """The options of one part as plain values; of files it starts from the content, not the name."""
    return bearing(OmegaConf.to_container(config[slot], resolve=True))


def bearing(node: object, without: Sequence[str] = ()) -> object:
    """The same of options that are plain already.

    Args:
        node: options.
        without: names of further ones that have no bearing, wherever they stand.
    """
    if isinstance(node, list):
        return [bearing(value, without) for value in node]
    if not isinstance(node, dict):
        return node
    kept = {str(name): bearing(value, without) for name, value in node.items() if name not in (*_WITHOUT, *without)}
    source = kept.get("weights")
    if isinstance(source, str) and Path(source).expanduser().is_file():
        with Path(source).expanduser().open("rb") as file:
            kept["weights"] = hashlib.file_digest(file, "sha256").hexdigest()
    return kept
