"""Increments against the analytic motion, Jacobians against re-integration, covariance against Monte Carlo."""

import time

import numpy as np
import pytest

from inertial_truth import even_stamps, exact_increment, make_rig, samples
from vioframe.errors import ConfigError, StateError
from vioframe.geometry import so3
from vioframe.interfaces import InertialIntegrator
from vioframe.testing import check_component
from vioframe.types import ImuBias, ImuBlock, ImuNoise, InertialDelta
from vioframe_preintegration import PaperIntegrator, Preintegration, Strapdown

START, END = 0.2, 1.8
LOUD = ImuNoise(gyro_noise=2e-3, gyro_walk=1e-5, accel_noise=2e-2, accel_walk=1e-4, rate_hz=200.0)


def ready(integrator: InertialIntegrator, noise: ImuNoise = LOUD) -> InertialIntegrator:
    integrator.setup(make_rig(noise))
    return integrator


def errors(delta: InertialDelta) -> np.ndarray:
    """Angle (rad) and lengths (m/s, m) by which an increment misses the exact one."""
    R, v, p = exact_increment(START, END)
    lengths = [np.linalg.norm(delta.delta_v - v), np.linalg.norm(delta.delta_p - p)]
    return np.array([so3.angle(R.T @ delta.delta_R), *lengths])


def apart(a: InertialDelta, b: InertialDelta) -> np.ndarray:
    """b − a as a tangent (9,), rotation local to a."""
    return np.concatenate([so3.log(a.delta_R.T @ b.delta_R), b.delta_v - a.delta_v, b.delta_p - a.delta_p])


ACCURATE = [
    pytest.param(Preintegration(method="midpoint"), 2, id="midpoint"),
    pytest.param(Preintegration(method="euler"), 1, id="euler"),
    pytest.param(Strapdown(), 3, id="strapdown"),
]
ALL = [
    pytest.param(Preintegration(method="midpoint"), id="midpoint"),
    pytest.param(Preintegration(method="euler"), id="euler"),
    pytest.param(Strapdown(), id="strapdown"),
    pytest.param(PaperIntegrator(), id="paper"),
]


@pytest.mark.parametrize(
    "options", [{"method": "rk4"}, {"max_gyro_bias_change": -1.0}, {"max_accel_bias_change": -1.0}]
)
def test_wrong_options_are_refused_by_name(options: dict) -> None:
    with pytest.raises(ConfigError, match=f"integrator.{next(iter(options))}"):
        Preintegration(**options)


def test_integrating_before_setup_is_refused() -> None:
    for integrator in (Preintegration(), Strapdown(), PaperIntegrator()):
        with pytest.raises(StateError, match="setup"):
            integrator.integrate(samples(even_stamps(0.0, 0.1, 10)), ImuBias())


@pytest.mark.parametrize("integrator", ALL)
def test_keeps_the_contract(integrator: InertialIntegrator) -> None:
    check_component(integrator)


@pytest.mark.parametrize(("integrator", "order"), ACCURATE)
def test_converges_at_its_order(integrator: InertialIntegrator, order: int) -> None:
    ready(integrator)
    recordings = [samples(even_stamps(START, END, n)) for n in (200, 400, 800)]
    missed = np.array([errors(integrator.integrate(imu, ImuBias())) for imu in recordings])
    measured = np.log2(missed[:-1] / missed[1:])
    assert np.all(np.abs(measured - order) < 0.1), measured


@pytest.mark.parametrize(("integrator", "order"), ACCURATE)
def test_converges_with_uneven_steps(integrator: InertialIntegrator, order: int) -> None:
    ready(integrator)
    missed = []
    for n in (200, 400):
        # Steps that stretch and shrink by two fifths over the time, the same way at any number.
        part = np.linspace(0.0, 1.0, n + 1)
        part = part + 0.4 * np.sin(2 * np.pi * part) / (2 * np.pi)
        stamps = np.round((START + (END - START) * part) * 1e9).astype(np.int64)
        missed.append(errors(integrator.integrate(samples(stamps), ImuBias())))
    np.testing.assert_allclose(np.log2(missed[0] / missed[1]), order, atol=0.15)


def test_the_bias_is_subtracted() -> None:
    integrator = ready(Preintegration())
    imu = samples(even_stamps(START, END, 400))
    bias = ImuBias(gyro=np.array([0.02, -0.05, 0.08]), accel=np.array([-0.3, 0.2, 0.1]))
    biased = ImuBlock(stamps_ns=imu.stamps_ns, gyro=imu.gyro + bias.gyro, accel=imu.accel + bias.accel)
    clean, corrected = integrator.integrate(imu, ImuBias()), integrator.integrate(biased, bias)
    np.testing.assert_allclose(apart(clean, corrected), 0.0, atol=1e-12)


@pytest.mark.parametrize(("integrator", "order"), ACCURATE)
def test_bias_jacobian_is_the_derivative_of_integrating_again(integrator: InertialIntegrator, order: int) -> None:
    ready(integrator)
    imu = samples(even_stamps(START, END, 320))
    start = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.05])
    delta = integrator.integrate(imu, ImuBias(gyro=start[:3], accel=start[3:]))
    step = 1e-5
    numeric = np.zeros((9, 6))
    for axis in range(6):
        ends = []
        for sign in (-1.0, 1.0):
            changed = start.copy()
            changed[axis] += sign * step
            ends.append(apart(delta, integrator.integrate(imu, ImuBias(gyro=changed[:3], accel=changed[3:]))))
        numeric[:, axis] = (ends[1] - ends[0]) / (2 * step)
    np.testing.assert_allclose(delta.bias_jacobian, numeric, atol=1e-6)


@pytest.mark.parametrize(("integrator", "order"), ACCURATE)
def test_at_is_first_order_near_and_exact_far(integrator: InertialIntegrator, order: int) -> None:
    ready(integrator)
    imu = samples(even_stamps(START, END, 320))
    delta = integrator.integrate(imu, ImuBias())
    near = ImuBias(gyro=np.full(3, 1e-3), accel=np.full(3, 1e-2))
    far = ImuBias(gyro=np.full(3, 0.1), accel=np.full(3, 0.5))
    missed_near = np.abs(apart(integrator.integrate(imu, near), delta.at(near)))
    moved = np.abs(apart(integrator.integrate(imu, near), delta))
    assert np.all(missed_near[:3] < 0.01 * moved[:3].max())
    assert np.all(missed_near < 0.02 * moved.max())
    np.testing.assert_allclose(apart(integrator.integrate(imu, far), delta.at(far)), 0.0, atol=1e-12)


@pytest.mark.parametrize("method", ["midpoint", "euler"])
def test_covariance_is_that_of_many_noisy_runs(method: str) -> None:
    integrator = ready(Preintegration(method=method))
    stamps = even_stamps(START, END, 160)
    imu = samples(stamps)
    exact = integrator.integrate(imu, ImuBias())
    random = np.random.default_rng(7)
    step_s = (END - START) / 160
    runs = 1500
    missed = np.empty((runs, 9))
    for run in range(runs):
        noisy = ImuBlock(
            stamps_ns=stamps,
            gyro=imu.gyro + random.normal(0.0, LOUD.gyro_noise / np.sqrt(step_s), imu.gyro.shape),
            accel=imu.accel + random.normal(0.0, LOUD.accel_noise / np.sqrt(step_s), imu.accel.shape),
        )
        missed[run] = apart(exact, integrator.integrate(noisy, ImuBias()))
    # Whitened by the stated covariance, the sample covariance must be the identity to about 3/√runs.
    whitened = np.linalg.solve(np.linalg.cholesky(exact.covariance), missed.T)
    sample = whitened @ whitened.T / runs
    np.testing.assert_allclose(sample, np.eye(9), atol=4.0 / np.sqrt(runs) + 0.02)


def test_two_derivations_agree_on_the_covariance() -> None:
    imu = samples(even_stamps(START, END, 800))
    closed_form = ready(Preintegration()).integrate(imu, ImuBias()).covariance
    recursion = ready(Strapdown()).integrate(imu, ImuBias()).covariance
    scale = np.sqrt(np.diag(closed_form))
    np.testing.assert_allclose((closed_form - recursion) / np.outer(scale, scale), 0.0, atol=1e-5)


@pytest.mark.parametrize(("integrator", "order"), ACCURATE)
def test_covariances_of_adjoining_windows_add_up(integrator: InertialIntegrator, order: int) -> None:
    """Cut anywhere, and propagated through the second window, two parts say what the whole says."""
    ready(integrator)
    stamps = even_stamps(START, END, 320)
    cut = int(stamps[150]) + 1_234_567
    whole_stamps = np.sort(np.append(stamps, cut))
    place = int(np.searchsorted(whole_stamps, cut))
    whole = integrator.integrate(samples(whole_stamps), ImuBias())
    first = integrator.integrate(samples(whole_stamps[: place + 1]), ImuBias())
    second = integrator.integrate(samples(whole_stamps[place:]), ImuBias())
    carry = np.eye(9)
    carry[:3, :3] = second.delta_R.T
    carry[3:6, :3] = -first.delta_R @ so3.hat(second.delta_v)
    carry[6:, :3] = -first.delta_R @ so3.hat(second.delta_p)
    carry[6:, 3:6] = second.duration_s * np.eye(3)
    turn = np.kron(np.diag([0.0, 1.0, 1.0]), first.delta_R) + np.kron(np.diag([1.0, 0.0, 0.0]), np.eye(3))
    joined = carry @ first.covariance @ carry.T + turn @ second.covariance @ turn.T
    scale = np.sqrt(np.diag(whole.covariance))
    np.testing.assert_allclose((joined - whole.covariance) / np.outer(scale, scale), 0.0, atol=2e-3)


@pytest.mark.parametrize("integrator", ALL)
def test_path_leads_from_nothing_to_the_increment(integrator: InertialIntegrator) -> None:
    ready(integrator)
    imu = samples(even_stamps(START, END, 100))
    delta = integrator.integrate(imu, ImuBias())
    assert delta.path is not None
    np.testing.assert_array_equal(delta.path.stamps_ns, imu.stamps_ns)
    np.testing.assert_array_equal(delta.path.delta_R[0], np.eye(3))
    assert not delta.path.delta_v[0].any() and not delta.path.delta_p[0].any()
    np.testing.assert_array_equal(delta.path.delta_R[-1], delta.delta_R)
    np.testing.assert_array_equal(delta.path.delta_v[-1], delta.delta_v)
    np.testing.assert_array_equal(delta.path.delta_p[-1], delta.delta_p)
    part = ImuBlock(stamps_ns=imu.stamps_ns[:41], gyro=imu.gyro[:41], accel=imu.accel[:41])
    inner = integrator.integrate(part, ImuBias())
    np.testing.assert_allclose(delta.path.delta_p[40], inner.delta_p, atol=1e-12)


@pytest.mark.parametrize("integrator", ALL)
def test_one_sample_is_no_motion(integrator: InertialIntegrator) -> None:
    ready(integrator)
    delta = integrator.integrate(samples(np.array([5], dtype=np.int64)), ImuBias())
    np.testing.assert_array_equal(delta.delta_R, np.eye(3))
    assert delta.duration_s == 0.0 and not delta.delta_v.any() and not delta.covariance.any()


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 9, 64, 65, 66, 131, 1000, 1001])
def test_the_scan_equals_the_loop(count: int) -> None:
    from vioframe_preintegration.rotations import cumulative_products

    steps = so3.exp(np.random.default_rng(count).normal(0.0, 0.5, (count, 3)))
    product = np.eye(3)
    scanned = cumulative_products(steps)
    for k, step in enumerate(steps):
        np.testing.assert_allclose(scanned[k], product, atol=1e-13)
        product = product @ step
    np.testing.assert_allclose(scanned[-1], product, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0999, 0.1001, 1.0, 3.0])
def test_fused_closed_forms_equal_those_of_so3(angle: float) -> None:
    from vioframe_preintegration.rotations import exp_and_right_jacobian

    direction = np.array([[0.3, -0.5, 0.8]]) / np.linalg.norm([0.3, -0.5, 0.8])
    rotation, jacobian = exp_and_right_jacobian(angle * direction)
    np.testing.assert_allclose(rotation, so3.exp(angle * direction), atol=1e-13)
    np.testing.assert_allclose(jacobian, so3.right_jacobian(angle * direction), atol=1e-10)


def test_strapdown_beats_the_midpoint_rule_under_coning() -> None:
    """The case it is for: an axis that cones at 10 Hz, sampled at 200 Hz, has a mean rate no sample shows."""
    t = even_stamps(0.0, 2.0, 400) / 1e9
    size, rate = np.radians(2.0), 2 * np.pi * 10.0
    yaw_pitch = size * np.stack([np.cos(rate * t), np.sin(rate * t)], axis=-1)
    phi = np.concatenate([yaw_pitch, np.zeros((len(t), 1))], axis=1)
    phi_rate = size * rate * np.stack([-np.sin(rate * t), np.cos(rate * t), np.zeros_like(t)], axis=-1)
    gyro = np.einsum("nij,nj->ni", so3.right_jacobian(phi), phi_rate)
    imu = ImuBlock(stamps_ns=np.round(t * 1e9).astype(np.int64), gyro=gyro, accel=np.zeros_like(gyro))
    exact = so3.exp(phi[0]).T @ so3.exp(phi[-1])
    missed = [so3.angle(exact.T @ ready(i).integrate(imu, ImuBias()).delta_R) for i in (Preintegration(), Strapdown())]
    assert missed[1] < 0.1 * missed[0]


def test_a_sample_close_to_its_neighbour_does_not_spoil_strapdown() -> None:
    """A re-stamped sample (synchronizer=nearest) gives a wild slope; the parabola must not follow it."""
    stamps = even_stamps(START, END, 320)
    stamps[0] = stamps[1] - 1000
    imu = samples(stamps)
    imu.gyro[0] += 0.05
    imu.accel[0] += 0.5
    clean = ready(Strapdown()).integrate(samples(stamps), ImuBias())
    noisy = ready(Strapdown()).integrate(imu, ImuBias())
    assert np.abs(apart(clean, noisy)).max() < 1e-5


def test_paper_form_is_the_printed_sums() -> None:
    imu = samples(even_stamps(START, END, 50))
    delta = ready(PaperIntegrator()).integrate(imu, ImuBias(gyro=np.ones(3), accel=np.ones(3)))
    R, v, p = np.eye(3), np.zeros(3), np.zeros(3)
    for k in range(50):
        step = (imu.stamps_ns[k + 1] - imu.stamps_ns[k]) * 1e-9
        p = p + v * step + 0.5 * imu.accel[k] * step**2
        v = v + imu.accel[k] * step
        R = R @ so3.exp(imu.gyro[k] * step)
    np.testing.assert_allclose(delta.delta_R, R, atol=1e-12)
    np.testing.assert_allclose(delta.delta_v, v, atol=1e-12)
    np.testing.assert_allclose(delta.delta_p, p, atol=1e-12)
    assert not delta.bias_jacobian.any() and not delta.bias.gyro.any()
    # And it is wrong as soon as the body turns: more samples do not help.
    finer = ready(PaperIntegrator()).integrate(samples(even_stamps(START, END, 1600)), ImuBias())
    assert errors(finer)[1] > 0.5


def test_a_wrong_sign_of_gravity_fails_loudly() -> None:
    """The specific force of a free fall is none: reading it as acceleration must be off by g t."""
    up = samples(even_stamps(START, END, 400), gravity=-9.81)
    delta = ready(Preintegration()).integrate(up, ImuBias())
    assert errors(delta)[1] == pytest.approx(2 * 9.81 * (END - START), rel=0.05)


def test_against_gtsam() -> None:
    """The same samples held over each step, as gtsam takes them."""
    gtsam = pytest.importorskip("gtsam")
    stamps = even_stamps(START, END, 320)
    imu = samples(stamps)
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setGyroscopeCovariance(LOUD.gyro_noise**2 * np.eye(3))
    params.setAccelerometerCovariance(LOUD.accel_noise**2 * np.eye(3))
    params.setIntegrationCovariance(1e-14 * np.eye(3))
    reference = gtsam.PreintegratedImuMeasurements(params)
    for k, step in enumerate(np.diff(stamps) * 1e-9):
        reference.integrateMeasurement(imu.accel[k], imu.gyro[k], step)
    delta = ready(Preintegration(method="euler")).integrate(imu, ImuBias())
    # gtsam's default (tangent) form equals Forster's to the first order of the step.
    np.testing.assert_allclose(delta.delta_R, reference.deltaRij().matrix(), atol=1e-3)
    np.testing.assert_allclose(delta.delta_v, reference.deltaVij(), rtol=0.01, atol=0.02)
    np.testing.assert_allclose(delta.delta_p, reference.deltaPij(), rtol=0.01, atol=0.02)
    # Order there is (rotation, p, v), and its rotation error is not local; the other two mean the same.
    theirs = np.sqrt(np.diag(reference.preintMeasCov()))[[6, 7, 8, 3, 4, 5]]
    np.testing.assert_allclose(theirs, np.sqrt(np.diag(delta.covariance))[3:], rtol=0.01)


def test_a_window_of_ten_samples_takes_well_under_a_millisecond() -> None:
    integrator = ready(Preintegration())
    imu, bias = samples(even_stamps(0.0, 0.05, 10)), ImuBias()
    integrator.integrate(imu, bias)
    taken = []
    for _ in range(5):
        started = time.process_time()
        for _ in range(50):
            integrator.integrate(imu, bias)
        taken.append((time.process_time() - started) / 50)
    assert min(taken) < 1e-3
