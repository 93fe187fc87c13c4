"""What of a part's options has a bearing on what it learns or answers: the words of a cache's key."""

import hashlib
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from vioframe.learning import SHIPPED

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
    if isinstance(source, str):
        file = Path(source).expanduser()
        if file.is_file():
            kept["weights"] = _hash(file)
        elif source == SHIPPED:
            kept["weights"] = _shipped(kept) or source
    return kept


def _shipped(options: dict[str, object]) -> list[str]:
    """Content of what a package keeps in its folder ``weights``; of several files, of those that the options name."""
    package = str(options.get("_target_", "")).partition(".")[0]
    # The specification of a package on top is found without importing it.
    spec = find_spec(package) if package else None
    if spec is None or not spec.submodule_search_locations:
        return []
    folder = Path(next(iter(spec.submodule_search_locations))) / "weights"
    files = sorted(file for file in folder.glob("*.safetensors") if file.is_file())
    named = [file for file in files if file.stem in _texts(options)]
    return [_hash(file) for file in named or files]


def _texts(node: object) -> set[str]:
    if isinstance(node, dict):
        return set().union(*map(_texts, node.values()))
    if isinstance(node, list):
        return set().union(*map(_texts, node))
    return {node} if isinstance(node, str) else set()


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
