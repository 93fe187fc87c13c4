"""Names, units and digits of the metrics, as the table and the report show them."""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

UNDEFINED = "undefined"


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """One metric in print.

    Attributes:
        key: in the row.
        label: in words.
        short: for a narrow column.
        unit: printed behind or above the number.
        factor: from the stored number to the printed one.
        signed: show a plus.
        digits: significant ones.
    """

    key: str
    label: str
    short: str
    unit: str = ""
    factor: float = 1.0
    signed: bool = False
    digits: int = 3


_FIXED = (
    Line(key="path_m", label="path", short="path", unit="m"),
    Line(key="ate_m", label="ATE, rms", short="ATE", unit="m", digits=7),
    Line(key="ate_mean_m", label="ATE, mean", short="mean", unit="m", digits=7),
    Line(key="ate_median_m", label="ATE, median", short="median", unit="m", digits=7),
    Line(key="ate_max_m", label="ATE, maximum", short="max.", unit="m", digits=7),
    Line(key="ate_se3_m", label="ATE, SE(3) aligned", short="ATE SE(3)", unit="m"),
    Line(key="ate_se3_percent", label="ATE, SE(3), of the path", short="ATE", unit="%"),
    Line(key="ate_yaw_m", label="ATE, yaw aligned", short="ATE yaw", unit="m"),
    Line(key="ate_sim3_m", label="ATE, Sim(3) aligned", short="ATE Sim(3)", unit="m"),
    Line(key="scale_error_percent", label="scale error", short="scale err.", unit="%", signed=True),
)
_DRIFT = (
    Line(key="t_rel_percent", label="t_rel (KITTI)", short="t_rel", unit="%", digits=4),
    Line(key="r_rel_deg_per_100m", label="r_rel (KITTI)", short="r_rel", unit="°/100 m", digits=4),
    Line(key="yaw_rmse_deg", label="yaw error", short="yaw", unit="°"),
    Line(key="gravity_rmse_deg", label="gravity direction error", short="gravity", unit="°"),
)
_CONSISTENCY = (
    Line(key="anees_position", label="ANEES per DoF, position", short="ANEES pos.", unit=""),
    Line(key="anees_orientation", label="ANEES per DoF, orientation", short="ANEES ori.", unit=""),
)
_RUNNING = (
    Line(key="completion", label="completion", short="complete", unit="%", factor=100.0, digits=4),
    Line(key="real_time_factor", label="real-time factor", short="real time", unit="×"),
)
_BRIEF = (
    "path_m",
    "ate_m",
    "ate_se3_m",
    "ate_se3_percent",
    "ate_sim3_m",
    "scale_error_percent",
    "t_rel_percent",
    "r_rel_deg_per_100m",
)
_RPE_PATTERN = re.compile(r"rpe_(?P<what>trans_percent|rot_deg|trans_m)_(?P<length>[0-9.e+-]+)(?P<unit>m|s)$")


def accuracy_lines(row: Mapping[str, object]) -> list[Line]:
    """The metrics that compare with the truth, in the order of print; RPE as the options asked for it."""
    rpe = (line for key in row if (line := _rpe_line(key)) is not None)
    return [line for line in (*_FIXED, *rpe, *_DRIFT) if line.key in row]


def brief_accuracy_lines(row: Mapping[str, object]) -> list[Line]:
    """Those of :func:`accuracy_lines` that are shown where several sequences have a row each."""
    return [line for line in accuracy_lines(row) if line.key in _BRIEF]


def running_lines(row: Mapping[str, object]) -> list[Line]:
    """The metrics of a run as such, in the order of print."""
    return [line for line in (*_CONSISTENCY, *_RUNNING) if line.key in row]


def has_run(row: Mapping[str, object]) -> bool:
    """Whether anything was processed; where nothing was, the error of the row says it all."""
    return row.get("windows") != 0


def _rpe_line(key: str) -> Line | None:
    match = _RPE_PATTERN.match(key)
    if match is None:
        return None
    over = f"{match['length']} {match['unit']}"
    kind, unit = {
        "trans_percent": ("translation", "%"),
        "trans_m": ("translation", "m"),
        "rot_deg": ("rotation", "°"),
    }[match["what"]]
    return Line(key=key, label=f"RPE over {over}, {kind}", short=f"RPE {over}", unit=unit)


def show(row: Mapping[str, object], line: Line, *, unit: bool = True) -> str:
    """The number in print, or ``undefined``."""
    value = row.get(line.key)
    if not isinstance(value, int | float):
        return UNDEFINED
    text = significant(value * line.factor, line.digits)
    if line.signed and value > 0.0:
        text = "+" + text
    separator = "" if line.unit in ("°", "×") else " "
    return f"{text}{separator}{line.unit}" if unit and line.unit else text


def significant(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, without an exponent where that stays readable."""
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -5 <= exponent <= 8:
        return f"{value:.{digits - 1}e}"
    # 9.9996 rounds up into the next decade; asking again keeps the digits right.
    decimals = max(digits - 1 - exponent, 0)
    return f"{value:.{min(decimals, 6)}f}"


def total_ms(row: Mapping[str, object]) -> str:
    """Wall milliseconds a window in print, or ``undefined``."""
    parts = row.get("ms_per_frame")
    return significant(float(parts["total"])) if isinstance(parts, Mapping) else UNDEFINED


def reasons(row: Mapping[str, object]) -> dict[str, list[str]]:
    """Labels of undefined metrics by reason, in print order."""
    undefined = row.get("undefined")
    if not isinstance(undefined, Mapping):
        return {}
    labels = {line.key: line.label for line in (*accuracy_lines(row), *running_lines(row))}
    by_reason: dict[str, list[str]] = {}
    for key, reason in undefined.items():
        if key in labels:
            by_reason.setdefault(str(reason), []).append(labels[key])
    return by_reason


def join(labels: Iterable[str], limit: int = 4) -> str:
    """A list in words, cut where it would only repeat itself."""
    names = list(labels)
    if len(names) <= limit:
        return "; ".join(names)
    return f"{'; '.join(names[: limit - 1])} and {len(names) - limit + 1} more"


def counter_text(row: Mapping[str, object]) -> str:
    """``dropped frames: 3, imu gaps: 1``, or nothing."""
    counters = row.get("counters")
    if not isinstance(counters, Mapping):
        return ""
    return ", ".join(f"{name}: {count}" for name, count in counters.items())


def calibration_text(row: Mapping[str, object]) -> str:
    """``calibration found, against the stated one: camera delay −1.7 ms, …``, or nothing."""
    found = row.get("calibration")
    if not isinstance(found, Mapping) or not found:
        return ""
    parts = [f"{name} {significant(float(change['value']))} {change['unit']}" for name, change in found.items()]
    return f"calibration found, against the stated one: {', '.join(parts)}"


def failure_text(row: Mapping[str, object]) -> str:
    """How a sequence ended that did not finish, and why."""
    status, error = str(row["status"]), str(row["error"])
    return error if error.startswith(status) else f"{status}: {error}"


def output_name(row: Mapping[str, object]) -> str:
    """``causal``, ``final``, or ``file`` where only its author knows."""
    protocol = row.get("protocol")
    return str(protocol.get("output", "")) if isinstance(protocol, Mapping) else ""


def protocol_text(row: Mapping[str, object]) -> str:
    """How the causal numbers of a row were measured, in one line."""
    protocol = row.get("protocol")
    if not isinstance(protocol, Mapping):
        return ""
    words = [f"{protocol.get('output')} output"]
    rate = protocol.get("rate_hz")
    if isinstance(rate, int | float):
        words.append(f"{rate:.3g} Hz")
    used = protocol.get("uses_ground_truth")
    faults = protocol.get("faults")
    for name, text in (
        ("alignment", "{} alignment"),
        ("init", "init={}"),
        ("states", "states {}"),
        ("nees_alignment", "ANEES aligned: {}"),
    ):
        if protocol.get(name):
            words.append(text.format(protocol[name]))
    if isinstance(used, list) and used:
        words.append(f"simulated from the truth: {', '.join(map(str, used))}")
    if isinstance(faults, list) and faults:
        words.append(f"injected faults: {', '.join(map(str, faults))}")
    return " · ".join(words)
