"""The pymunk world against closed forms."""

import copy

import numpy as np
import pytest

from freeflyer_env import Obstacles, Robot, Scenario
from freeflyer_env.physics import World

EMPTY = Scenario(Obstacles.from_rows([]))
ROBOT = Robot()


@pytest.mark.parametrize("sub_steps", [1, 3, 10])
def test_constant_force_without_rotation_is_exact(sub_steps):
    world = World(EMPTY)
    world.state = [1.0, 1.0, 0.0, 0.01, -0.02, 0.0]
    for _ in range(6):
        world.advance(0.5, sub_steps, np.tile([0.3, 0.1, 0.0], (sub_steps, 1)))
    t, a = 3.0, np.array([0.3, 0.1]) / ROBOT.mass
    expected = np.array([1.0, 1.0]) + t * np.array([0.01, -0.02]) + 0.5 * a * t**2
    np.testing.assert_allclose(world.state[:2], expected, atol=1e-9)
    np.testing.assert_allclose(world.state[3:5], [0.01 + a[0] * t, -0.02 + a[1] * t], atol=1e-9)


@pytest.mark.parametrize("sub_steps", [1, 3, 10])
def test_constant_torque_is_exact(sub_steps):
    world = World(EMPTY)
    world.state = [1.0, 1.0, 0.2, 0.0, 0.0, 0.1]
    for _ in range(6):
        world.advance(0.5, sub_steps, np.tile([0.0, 0.0, 0.01], (sub_steps, 1)))
    alpha = 0.01 / ROBOT.inertia
    assert world.state[2] == pytest.approx(0.2 + 0.3 + 0.5 * alpha * 9.0, abs=1e-9)
    assert world.state[5] == pytest.approx(0.1 + 3.0 * alpha, abs=1e-9)


def test_drift_conserves_momentum():
    world = World(EMPTY)
    world.state = [1.0, 1.0, 0.2, 0.03, 0.02, 0.4]
    for _ in range(20):
        world.advance(0.5, 10)
    np.testing.assert_allclose(world.state[3:], [0.03, 0.02, 0.4], atol=1e-12)
    np.testing.assert_allclose(world.state[:3], [1.3, 1.2, 4.2], atol=1e-9)


def test_body_force_turns_with_the_body_and_converges():
    """A forward force on a spinning robot: velocity Verlet is of second order."""

    def final(sub_steps):
        world = World(EMPTY)
        world.state = [1.5, 1.2, 0.0, 0.0, 0.0, 0.5]
        for _ in range(8):
            world.advance(0.5, sub_steps, np.tile([0.3, 0.0, 0.0], (sub_steps, 1)))
        return world.state

    exact = np.array([np.sin(2.0), 1.0 - np.cos(2.0)]) * 0.3 / ROBOT.mass / 0.5
    errors = [np.abs(final(n)[3:5] - exact).max() for n in (2, 4, 8)]
    assert errors[2] < 5e-6
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_head_on_contact_with_a_disc(restitution):
    world = World(Scenario(Obstacles.from_rows([[2.0, 1.25, 0.2]])), restitution=restitution)
    world.state = [1.4, 1.25, 0.0, 0.1, 0.0, 0.0]
    world.advance(8.0, 160)
    np.testing.assert_allclose(world.state[3:], [-restitution * 0.1, 0.0, 0.0], atol=1e-6)
    log = world.take_contacts().to_info()
    assert log["with"] == [0]
    assert log["count"] == 1
    assert log["impulse"] == pytest.approx(ROBOT.mass * 0.1 * (1 + restitution), rel=1e-3)
    assert world.take_contacts().to_info() == {"count": 0, "impulse": 0.0, "with": []}


def test_grazing_contact_conserves_tangential_momentum():
    world = World(EMPTY, restitution=0.5, friction=0.0)
    world.state = [1.0, 0.3, 0.0, 0.05, -0.1, 0.2]
    world.advance(4.0, 80)
    assert world.state[3] == pytest.approx(0.05, abs=1e-9)
    assert world.state[4] == pytest.approx(0.05, abs=1e-6)
    assert world.state[5] == pytest.approx(0.2, abs=1e-9)
    assert world.take_contacts().to_info()["with"] == ["wall"]


def test_the_robot_stays_on_the_table():
    world, rng = World(EMPTY, restitution=1.0), np.random.default_rng(0)
    world.state = [1.0, 1.0, 0.0, *rng.uniform(-0.5, 0.5, 2), 0.0]
    for _ in range(40):
        world.advance(0.5, 10)
        assert (world.state[:2] > ROBOT.radius - 5e-3).all()
        assert (world.state[:2] < np.array(EMPTY.table) - ROBOT.radius + 5e-3).all()


@pytest.mark.parametrize("seed", [22, 42])
def test_two_contacts_at_once_do_not_depend_on_the_way_there(seed):
    """In a corner the order of the two contacts matters; these seeds tell when it varies."""
    world, rng = World(EMPTY, restitution=0.5, friction=0.5), np.random.default_rng(seed)
    world.state = [0.4, 0.4, 0.0, *rng.uniform(-0.3, 0.0, 2), 0.5]
    for step in range(60):
        kick = np.array([*rng.uniform(-0.12, 0.08, 2), rng.uniform(-0.3, 0.3)])
        if step % 6 == 0:
            twin = copy.deepcopy(world)
        for each in (world, twin):
            each.kick(kick)
            each.advance(0.5, 10)
        np.testing.assert_array_equal(world.state, twin.state)


def test_without_contacts_it_passes_through():
    world = World(Scenario(Obstacles.from_rows([[2.0, 1.25, 0.2]])), solid=False)
    world.state = [1.4, 1.25, 0.0, 0.1, 0.0, 0.0]
    world.advance(8.0, 20)
    assert world.state[0] == pytest.approx(2.2, abs=1e-9)


@pytest.mark.parametrize("name", ["restitution", "friction"])
def test_bad_surface(name):
    with pytest.raises(ValueError, match=name):
        World(EMPTY, **{name: 1.5})


def test_free_flight_and_pymunk_agree():
    """A world that pymunk has from the start takes the same way as one in closed form."""
    free, engaged = World(EMPTY), World(EMPTY)
    rng = np.random.default_rng(0)
    for world in (free, engaged):
        world.state = [1.5, 1.2, 0.3, 0.02, -0.01, 0.1]
    engaged._engage()
    engaged._require_space().collision_persistence = 10**6  # it is never handed back
    for _ in range(20):
        wrenches = rng.uniform(-1, 1, (10, 3)) * [0.4, 0.4, 0.04]
        for world in (free, engaged):
            world.advance(0.1, 10, wrenches)
            world.advance(0.5, 10)
        np.testing.assert_allclose(free.state, engaged.state, atol=1e-12)
    assert engaged._engaged
    assert not free._engaged


def test_a_moving_disc_pushes_the_robot():
    obstacles = Obstacles(np.array([[1.0, 1.2]]), [0.2], [[0.1, 0.0]])
    world = World(Scenario(obstacles), restitution=1.0)
    world.state = [1.5, 1.2, 0.0, 0.0, 0.0, 0.0]
    world.advance(1.0, 100)
    assert world.state[3] == 0.0
    world.advance(1.0, 100)
    assert world.state[3] == pytest.approx(0.2, abs=1e-9)
    world.advance(3.0, 100)
    assert world.state[0] == pytest.approx(1.5 + 0.2 * 3.5, abs=2e-3)
    assert world.take_contacts().to_info()["with"] == [0]


def test_a_copy_made_while_an_obstacle_pushes_goes_the_same_way():
    track = [[[0.0, 1.0, 1.2], [2.0, 1.3, 1.3], [5.0, 1.0, 1.0]]]
    world = World(Scenario(Obstacles.along(track, [0.2])), restitution=0.0, friction=0.5)
    world.state = [1.4, 1.2, 0.0, 0.0, 0.0, 0.1]
    for _ in range(25):
        world.advance(0.1, 10)
        twin = copy.deepcopy(world)
        for _ in range(10):
            twin.advance(0.1, 10)
        ahead = copy.deepcopy(world)
        for _ in range(10):
            ahead.advance(0.1, 10)
        np.testing.assert_array_equal(twin.state, ahead.state)
    assert world.take_contacts().count > 0


def test_collisions_conserve_angular_momentum_about_the_contact():
    """Friction acts at the point of contact, so it cannot change the moment about it."""
    world = World(Scenario(Obstacles.from_rows([[2.0, 1.25, 0.2]])), friction=1.0)
    world.state = [1.4, 1.25, 0.0, 0.1, 0.0, 2.0]

    def moment(state):
        lever = state[:2] - np.array([1.8, 1.25])
        return ROBOT.mass * (lever[0] * state[4] - lever[1] * state[3]) + ROBOT.inertia * state[5]

    before = moment(world.state)
    world.advance(4.0, 4000)
    assert world.take_contacts().count == 1
    assert world.state[4] != 0.0
    assert moment(world.state) == pytest.approx(before, abs=1e-3)
