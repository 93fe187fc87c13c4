"""Training of the parts that have a net: batches, data loading, the loop, weights on disk.

Importing this package costs nothing; its modules import torch (and, those that train, lightning). They come with
``pip install 'vioframe[learn]'``: whoever is about to import one of them calls :func:`require_torch` first, so that a
user who lacks it reads one sentence.
"""

from importlib.util import find_spec

from vioframe.errors import ConfigError

SHIPPED = "shipped"
"""Value of an option ``weights`` that stands for what came with the part's package, in its folder ``weights``."""


def require_torch(what: str, *, training: bool = False) -> None:
    """Refuse to go on without the libraries that nets need.

    Args:
        what: who needs them, as the user chose it, such as ``"vo=tsvo"``.
        training: whether it trains, which takes lightning too.

    Raises:
        ConfigError: with the command that installs them.
    """
    needed = ("torch", "safetensors", "lightning") if training else ("torch", "safetensors")
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"{what} needs {' and '.join(missing)}, which is not installed: pip install 'vioframe[learn]'"
        )
