"""Every error a user can meet.

::

    VioframeError
    ├── ConfigError        names the config key and its value
    │   ├── PluginError    missing, clashing or broken plugin: distribution and file
    │   ├── TargetError    a _target_ outside the discovered packages
    │   └── WiringError    a component needs what nothing provides: names all choices
    ├── DataError          a recording, calibration or checkpoint: names file and line or stamp
    │   ├── ShapeError     field, expected, got
    │   └── ClockError     stamps out of order, no overlap, implausible offset
    ├── MetricError        a metric undefined on this trajectory (100 m segments on a 92 m path)
    └── StateError         a call out of order

A message says what is wrong, which value, where, and what to do about it. They are raised at the
door (constructor, ``setup``, reader); inner loops trust their inputs. Bad data in mid-run is not an
error: it is ``RelativePose.valid = False``, ``NavState.status = "lost"`` or ``SyncedWindow.gap_ns``.
"""


class VioframeError(Exception):
    """Root of everything vioframe raises on purpose; the command line shows it without a traceback."""


class ConfigError(VioframeError):
    """A configuration value that cannot work; names the config key and its value."""


class PluginError(ConfigError):
    """A plugin that is missing, clashes with another or does not import."""


class TargetError(ConfigError):
    """A ``_target_`` outside the packages a config may build from."""


class WiringError(ConfigError):
    """A component needs what nothing before it provides."""


class DataError(VioframeError):
    """A recording, calibration or trajectory file that cannot be used as it is."""


class ShapeError(DataError):
    """An array with the wrong shape, dtype or content."""


class ClockError(DataError):
    """Stamps out of order, without overlap, or with an implausible offset or unit."""


class MetricError(VioframeError):
    """A metric that is not defined on this trajectory."""


class StateError(VioframeError):
    """A call out of order, such as ``push`` before ``setup``."""
