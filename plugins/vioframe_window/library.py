"""The door to gtsam: slow to import and not built for every machine, so all that needs it is imported behind it."""

from importlib.util import find_spec

from vioframe.errors import PluginError


def require_gtsam() -> None:
    """Say what to do where gtsam is not installed.

    Raises:
        PluginError: it is not.
    """
    if find_spec("gtsam") is None:
        raise PluginError(
            "fuser=window solves its window with gtsam, which is not installed: pip install 'gtsam>=4.3,<4.4', "
            "or choose fuser=msckf, which needs nothing more"
        )
