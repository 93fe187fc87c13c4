"""Noise is raised while sensors contradict each other, and only then."""

import numpy as np
import pytest

from vioframe.consistency import NoiseAdaptation

WINDOW_S = 0.05
TIME_S = 0.5
MOST = 30.0


@pytest.fixture
def adapted() -> NoiseAdaptation:
    return NoiseAdaptation(TIME_S, MOST)


@pytest.fixture
def S() -> np.ndarray:
    """A covariance (6, 6) of innovations, correlated within and between the blocks."""
    root = np.random.default_rng(4).normal(size=(6, 6)) * np.repeat([1e-3, 2e-2], 3)[:, None]
    return root @ root.T + np.diag(np.repeat([1e-6, 1e-4], 3))


def test_noise_as_stated_stays_as_stated(adapted, S):
    rng = np.random.default_rng(5)
    factors = []
    for residual in rng.multivariate_normal(np.zeros(6), S, size=2000):
        adapted.learn(residual, S, WINDOW_S)
        factors.append((adapted.inertial, adapted.translation))
    # Single draws push it up a little; it comes back.
    assert np.min(factors) == 1.0
    assert np.median(factors, axis=0) == pytest.approx([1.0, 1.0], abs=0.1)
    assert np.max(factors) < 3.0


@pytest.mark.parametrize("true_factor", [4.0, 10.0])
def test_finds_the_factor_by_which_the_noise_is_larger(adapted, S, true_factor):
    rng = np.random.default_rng(6)
    factors = []
    for residual in rng.multivariate_normal(np.zeros(6), S, size=2000):
        raised = np.repeat([adapted.inertial, adapted.translation], 3)
        adapted.learn(true_factor * residual, raised[:, None] * S * raised, WINDOW_S)
        factors.append(raised[[0, 3]])
    # Equilibrium is where min(χ²/3, 9) has a mean of 1.6: at a factor of true/√1.6.
    assert np.mean(factors[500:], axis=0) == pytest.approx(true_factor / np.sqrt([1.6, 1.6]), rel=0.1)


@pytest.mark.parametrize(("part", "inertial_raised"), [(slice(0, 3), True), (slice(3, 6), False)])
def test_each_block_speaks_of_its_own_sensor(adapted, S, part, inertial_raised):
    residual = np.zeros(6)
    residual[part] = 5.0 * np.sqrt(np.diag(S)[part])
    for _ in range(10):
        adapted.learn(residual, S, WINDOW_S)
    raised, other = adapted.inertial, adapted.translation
    if not inertial_raised:
        raised, other = other, raised
    assert raised > 3.0
    assert other == 1.0


def test_rises_within_its_time_and_no_further_than_allowed(adapted):
    outlier = np.full(6, 1e3)
    adapted.learn(outlier, np.eye(6), WINDOW_S)
    # The largest step: a single outlier, however far off, raises the variance by exp(T/τ (9 − 1.6)).
    assert adapted.inertial == pytest.approx(np.exp(0.5 * WINDOW_S / TIME_S * 7.4))
    for _ in range(100):
        adapted.learn(outlier, np.eye(6), WINDOW_S)
    assert adapted.inertial == pytest.approx(MOST)
    assert adapted.translation == pytest.approx(MOST)


def test_decays_once_the_sensors_agree(adapted):
    for _ in range(20):
        adapted.learn(np.full(6, 1e3), np.eye(6), WINDOW_S)
    highest = adapted.inertial
    adapted.learn(np.zeros(6), np.eye(6), WINDOW_S)
    assert adapted.inertial == pytest.approx(highest * np.exp(-0.5 * WINDOW_S / TIME_S * 1.6))
    for _ in range(100):
        adapted.learn(np.zeros(6), np.eye(6), WINDOW_S)
    assert adapted.inertial == adapted.translation == 1.0


def test_believes_the_odometry_again_when_told(adapted):
    for _ in range(20):
        adapted.learn(np.full(6, 1e3), np.eye(6), WINDOW_S)
    inertial = adapted.inertial
    adapted.believe_translation()
    assert adapted.translation == 1.0
    assert adapted.inertial == inertial > 1.0


def test_most_of_one_adapts_nothing():
    still = NoiseAdaptation(TIME_S, 1.0)
    still.learn(np.full(6, 1e3), np.eye(6), WINDOW_S)
    assert still.inertial == still.translation == 1.0
