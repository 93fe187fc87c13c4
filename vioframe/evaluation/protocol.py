"""What every number travels with: how it was measured."""

from dataclasses import asdict, dataclass
from typing import Literal

from vioframe.errors import ConfigError
from vioframe.evaluation.align import AssociationMethod

Output = Literal["causal", "final", "file"]

STATE_CHOICE = "tracking and lost"
"""Which states are compared: all but those from before the fuser had initialised itself. Leaving out ``lost``
ones as well would hide a failure from the error it causes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationOptions:
    """What a user may choose; the group ``evaluation`` of the configuration.

    Attributes:
        association: ``interpolate`` the truth at the stamps of the estimate, or pair ``nearest`` stamps.
        max_gap_s: ``interpolate`` bridges no longer hole of the truth; poses of the truth *at* a stamp always count.
        max_difference_s: ``nearest`` pairs no stamps further apart.
        segment_lengths_m: of t_rel and r_rel, along the truth.
        segment_step: frames from the start of one segment to that of the next.
        rpe_distances_m: of the relative pose error by distance.
        rpe_times_s: of the relative pose error by time.
        plots: draw the figures and the report.
    """

    association: AssociationMethod = "interpolate"
    max_gap_s: float = 0.11
    max_difference_s: float = 0.01
    segment_lengths_m: tuple[float, ...] = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
    segment_step: int = 10
    rpe_distances_m: tuple[float, ...] = (1.0, 10.0)
    rpe_times_s: tuple[float, ...] = (1.0,)
    plots: bool = True

    def __post_init__(self) -> None:
        if self.association not in ("interpolate", "nearest"):
            raise ConfigError(f"evaluation.association must be interpolate or nearest, got {self.association!r}")
        for name in ("max_gap_s", "max_difference_s"):
            if not getattr(self, name) >= 0.0:
                raise ConfigError(f"evaluation.{name} must not be negative, got {getattr(self, name)}")
        for name in ("segment_lengths_m", "rpe_distances_m", "rpe_times_s"):
            values = tuple(float(value) for value in getattr(self, name))
            if not all(value > 0.0 for value in values):
                raise ConfigError(f"evaluation.{name} must be positive, got {list(values)}")
            # A list out of a YAML file becomes the tuple that the annotation promises.
            object.__setattr__(self, name, values)
        if self.segment_step < 1:
            raise ConfigError(f"evaluation.segment_step must be at least 1, got {self.segment_step}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """How the numbers of one row were measured.

    Attributes:
        options: association tolerance, segment lengths and the like.
        output: ``causal``, as given while running, ``final``, smoothed afterwards, or ``file``, which does not say.
        rate_hz: of the poses compared, or None where there are none.
        truth_rate_hz: of the ground truth, or None.
        init: how the fuser was started; empty for a file.
        uses_ground_truth: parts that simulate a sensor from the truth.
        faults: what was spoilt on purpose in the recording.
        nees_alignment: what was aligned before errors were weighed with their covariance.
    """

    options: EvaluationOptions
    output: Output
    rate_hz: float | None
    truth_rate_hz: float | None
    init: str
    uses_ground_truth: tuple[str, ...]
    faults: tuple[str, ...]
    nees_alignment: str

    def as_dict(self) -> dict[str, object]:
        """For ``metrics.json``: what belongs to one row only."""
        document = asdict(self)
        del document["options"]
        document["uses_ground_truth"] = list(self.uses_ground_truth)
        document["faults"] = list(self.faults)
        document["states"] = STATE_CHOICE
        return document

    def describe(self) -> str:
        """One line for captions."""
        words = [f"{self.output} output"]
        if self.rate_hz is not None:
            words.append(f"{self.rate_hz:.3g} Hz")
        words.append(describe_association(self.options))
        if self.init:
            words.append(f"init={self.init}")
        if self.uses_ground_truth:
            words.append(f"simulated from the truth: {', '.join(self.uses_ground_truth)}")
        if self.faults:
            words.append(f"injected faults: {', '.join(self.faults)}")
        return " · ".join(words)


def describe_association(options: EvaluationOptions) -> str:
    """How poses were paired, in words."""
    if options.association == "nearest":
        return f"nearest stamps within {options.max_difference_s:g} s"
    return f"truth interpolated over gaps up to {options.max_gap_s:g} s"


def describe_options(options: EvaluationOptions) -> dict[str, object]:
    """For ``metrics.json``: what all rows share, with the definition of each metric."""
    return {
        "alignment": {
            "ate_se3_m": "SE(3), least squares over all positions",
            "ate_yaw_m": "rotation about z and translation, least squares over all positions",
            "ate_sim3_m": "Sim(3), least squares over all positions",
            "anees_*": "see nees_alignment of each sequence",
            "other": "none: relative, or invariant",
        },
        "association": options.association,
        "association_tolerance_s": (
            options.max_difference_s if options.association == "nearest" else options.max_gap_s
        ),
        "segment_lengths_m": list(options.segment_lengths_m),
        "segment_step_frames": options.segment_step,
        "rpe_distances_m": list(options.rpe_distances_m),
        "rpe_times_s": list(options.rpe_times_s),
        "states": STATE_CHOICE,
        "definitions": dict(DEFINITIONS),
    }


DEFINITIONS: dict[str, str] = {
    "path_m": "length of the ground truth over the compared poses",
    "ate_*_m": "root mean square position error after the alignment",
    "sim3_scale": "metres of the truth per metre of the estimate",
    "scale_error_percent": "100 (1 / sim3_scale - 1): positive where the estimate is too large",
    "rpe_trans_percent_<d>m": "root mean square relative translation error over all pairs d metres of truth apart, "
    "in percent of the length of the pair",
    "rpe_rot_deg_<d>m": "root mean square relative rotation error over the same pairs",
    "rpe_trans_m_<t>s, rpe_rot_deg_<t>s": "the same over all pairs t seconds apart",
    "t_rel_percent, r_rel_deg_per_100m": "KITTI: mean over all segments of segment_lengths_m",
    "yaw_rmse_deg": "root mean square error about the vertical, less its (circular) mean",
    "gravity_rmse_deg": "root mean square angle between the true and the estimated vertical, in the body",
    "anees_*": "mean normalised estimation error squared per degree of freedom of the states with status tracking: "
    "1 is consistent, more is overconfident",
    "completion": "windows that ended with status tracking / windows that the frames of the recording make",
    "real_time_factor": "seconds of recording / seconds inside the pipeline",
    "ms_per_frame": "wall milliseconds inside each part / windows processed",
}
"""What each metric is."""
