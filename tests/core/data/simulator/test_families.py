"""Every family stays in its world, rests when it should, and is the same for the same seed."""

import numpy as np
import pytest

from vioframe.data.simulator.degrade import Degradations
from vioframe.data.simulator.families import FAMILIES, family_traits, plan_motion
from vioframe.data.simulator.imaging import build_world
from vioframe.data.simulator.world import World
from vioframe.errors import ConfigError


def test_an_unknown_family_is_named_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"jog.*walk"):
        family_traits("jog")


@pytest.mark.parametrize(("duration_s", "standstill_s"), [(0.0, 0.0), (-1.0, 0.0), (np.nan, 0.0), (1.0, -1.0)])
def test_durations_that_cannot_be_are_refused(duration_s: float, standstill_s: float) -> None:
    with pytest.raises(ConfigError):
        plan_motion("walk", 0, duration_s, standstill_s)


@pytest.mark.parametrize("family", list(FAMILIES))
def test_every_family_stays_clear_of_its_world(family: str) -> None:
    traits = family_traits(family)
    seed, duration_s = 11, min(traits.duration_s, 60.0)
    plan = plan_motion(family, seed, duration_s, traits.standstill_s)
    world = World(build_world(plan, seed, duration_s, Degradations()))
    path = plan.motion.evaluate(np.arange(0.0, duration_s, 0.02)).T_world_body[:, :3, 3]
    assert world.clearance(path).min() > 0.3


@pytest.mark.parametrize("family", list(FAMILIES))
def test_every_family_starts_at_rest_and_then_moves(family: str) -> None:
    plan = plan_motion(family, 1, 20.0, 2.0)
    rest = plan.motion.evaluate(np.arange(0.0, 1.9, 0.05))
    assert np.abs(rest.velocity).max() < 1e-9
    assert np.abs(rest.acceleration).max() < 1e-7
    assert np.abs(rest.rotation_rate).max() < 1e-9
    later = plan.motion.evaluate(np.arange(4.0, 20.0, 0.05))
    assert max(np.abs(later.velocity).max(), np.abs(later.rotation_rate).max()) > 0.3


@pytest.mark.parametrize("family", list(FAMILIES))
def test_motions_are_what_a_body_can_do(family: str) -> None:
    for seed in range(3):
        state = plan_motion(family, seed, 40.0, 2.0).motion.evaluate(np.arange(0.0, 40.0, 0.02))
        limit = {"car": 16.0, "drone": 7.0}.get(family, 2.5)
        assert np.linalg.norm(state.velocity, axis=1).max() < limit
        assert np.linalg.norm(state.acceleration, axis=1).max() < 12.0
        assert np.linalg.norm(state.rotation_rate, axis=1).max() < 4.0


def test_a_walk_shows_its_scale_to_an_accelerometer() -> None:
    state = plan_motion("walk", 0, 30.0, 2.0).motion.evaluate(np.arange(3.0, 30.0, 0.02))
    assert np.sqrt(np.mean(state.acceleration**2, axis=0)).min() > 0.3


def test_pure_rotation_does_not_move() -> None:
    state = plan_motion("rotation", 0, 20.0, 2.0).motion.evaluate(np.arange(0.0, 20.0, 0.02))
    assert np.ptp(state.T_world_body[:, :3, 3], axis=0).max() < 1e-9


def test_a_car_drives_level_and_along_its_axis() -> None:
    plan = plan_motion("car", 0, 100.0, 0.0)
    state = plan.motion.evaluate(np.arange(1.0, 99.0, 0.05))
    np.testing.assert_allclose(state.T_world_body[:, 2, 2], 1.0, atol=1e-12)
    speed = np.linalg.norm(state.velocity, axis=1)
    along = np.sum(state.T_world_body[:, :3, 0] * state.velocity, axis=1)
    np.testing.assert_allclose(along, speed, rtol=0.02)
    assert 7.0 < speed.mean() < 15.0


def test_a_corridor_is_long_and_comes_back() -> None:
    position = plan_motion("corridor", 0, 70.0, 2.0).motion.evaluate(np.arange(0.0, 70.0, 0.1)).T_world_body[:, :3, 3]
    assert np.ptp(position[:, 0]) > 30.0
    assert abs(position[-1, 0] - position[0, 0]) < 12.0


def test_a_patrol_comes_back_to_where_it_began_and_goes_on_along_the_same_way() -> None:
    for seed in range(3):
        position = (
            plan_motion("building", seed, 116.0, 2.0).motion.evaluate(np.arange(0.0, 115.0, 0.1)).T_world_body[:, :3, 3]
        )
        metres = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1))])
        late, early = position[metres > 100.0], position[metres < 60.0]
        apart = np.linalg.norm(late[:, None, :2] - early[None, :, :2], axis=2)
        on_the_way_again = np.arange(len(late)) > apart[:, 0].argmin()
        assert metres[-1] > 115.0
        assert apart[:, 0].min() < 0.7
        assert apart[on_the_way_again].min(axis=1).max() < 1.0
        assert on_the_way_again.sum() * 0.1 * 1.2 > 10.0


def test_a_building_is_planned_along_the_whole_lap_however_much_of_it_is_walked() -> None:
    short, long = (plan_motion("building", 2, duration_s, 2.0).route for duration_s in (10.0, 116.0))
    assert short is not None
    assert long is not None
    np.testing.assert_array_equal(short, long)
    walked = plan_motion("building", 2, 116.0, 2.0).motion.evaluate(np.arange(0.0, 115.0, 0.5)).T_world_body[:, :3, 3]
    assert np.linalg.norm(walked[:, None, :2] - long[None, :, :2], axis=2).min(axis=1).max() < 0.5


@pytest.mark.parametrize("family", list(FAMILIES))
def test_seeds_make_motions(family: str) -> None:
    times = np.arange(0.0, 10.0, 0.5)
    first, again, other = (plan_motion(family, seed, 10.0, 1.0).motion.evaluate(times) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.T_world_body, again.T_world_body)
    assert np.abs(first.T_world_body - other.T_world_body).max() > 0.01


def test_moving_objects_cross_the_room_but_never_meet_the_body() -> None:
    plan = plan_motion("walk", 3, 20.0, 2.0)
    world_plan = build_world(plan, 3, 20.0, Degradations(moving_objects=3))
    assert len(world_plan.moving) == 3
    world = World(world_plan)
    times = np.arange(0.0, 20.0, 0.05)
    path = plan.motion.evaluate(times).T_world_body[:, :3, 3]
    nearest = []
    for t_s, point in zip(times, path, strict=True):
        world.move_to(t_s)
        nearest.append(world.clearance(point[None])[0])
    assert min(nearest) > 0.3
