"""Disturbances: each one does what its name says, and nothing else."""

import math

import gymnasium as gym
import numpy as np
import pytest

from freeflyer_env import Obstacles, Problem, Robot, Scenario
from freeflyer_env.disturbances import Disturbances, Plant
from freeflyer_env.physics import World

EMPTY = Scenario(Obstacles.from_rows([]))
START, GOAL = [1.0, 1.2, 0.4, 0, 0, 0], [3.2, 1.2, 0.4, 0, 0, 0]
ROBOT = Robot()


def make(mode="delta_v", **fields):
    env = gym.make("FreeFlyer-v0", scenario=EMPTY, action_mode=mode, disturbances=fields)
    env.reset(seed=3, options={"problem": Problem(EMPTY, START, GOAL)})
    return env.unwrapped


def test_nothing_is_disturbed_by_default():
    env = gym.make("FreeFlyer-v0").unwrapped
    env.reset(seed=0)
    assert env.disturbances == Disturbances()
    np.testing.assert_array_equal(env.measured_state, env.state)


def test_measurements_scatter_about_the_truth():
    fields = {"position_noise": 1e-3, "heading_noise": 2e-3, "velocity_noise": 3e-3}
    env = make(**fields, rate_noise=4e-3)
    errors = []
    for _ in range(70):
        observation, *_ = env.step(np.zeros(3))
        np.testing.assert_allclose(observation["state"], env.measured_state, atol=1e-6)
        errors.append(env.measured_state - env.state)
    expected = [1e-3, 1e-3, 2e-3, 3e-3, 3e-3, 4e-3]
    np.testing.assert_allclose(np.std(errors, axis=0), expected, rtol=0.35)


@pytest.mark.parametrize("mode", ["delta_v", "thrusters"])
def test_a_tilted_table_is_a_constant_acceleration(mode):
    env = make(mode, table_tilt=1e-3)
    for _ in range(20):
        env.step(np.zeros(env.action_space.shape))
    moved = env.state[:2] - START[:2]
    assert np.hypot(*moved) == pytest.approx(0.5 * 9.81e-3 * env.time**2, rel=1e-9)
    assert env.state[5] == 0.0


def test_the_centre_of_mass_flies_straight():
    world = World(EMPTY, plant=Plant(ROBOT, np.ones(8), com=(0.03, -0.01)))
    world.state = [1.0, 1.0, 0.3, 0.02, 0.01, 0.5]
    before = world.state
    lever = np.array([0.03, -0.01])

    def centre(state):
        cos, sin = np.cos(state[2]), np.sin(state[2])
        return state[:2] + np.array([[cos, -sin], [sin, cos]]) @ lever

    first = centre(before)
    world.advance(1.0, 7)
    second = centre(world.state)
    world.advance(2.0, 5)
    np.testing.assert_allclose(centre(world.state) - second, 2 * (second - first), atol=1e-12)
    assert np.abs(world.state[3:5] - before[3:5]).max() > 1e-3


def test_a_push_through_the_hulls_centre_turns_an_unbalanced_robot():
    world = World(EMPTY, plant=Plant(ROBOT, np.ones(8), com=(0.0, 0.01)))
    world.state = START
    world.advance(1.0, 10, np.tile([0.4, 0.0, 0.0], (10, 1)))
    assert world.state[5] == pytest.approx(0.4 * 0.01 / ROBOT.inertia, rel=1e-9)
    other = World(EMPTY, plant=Plant(ROBOT, np.ones(8), com=(0.0, 0.01)))
    other.state = START
    other.impulse(np.array([0.4, 0.0, 0.0]))
    assert other.state[5] == pytest.approx(0.4 * 0.01 / ROBOT.inertia, rel=1e-9)


@pytest.mark.parametrize("mode", ["delta_v", "thrusters", "on_off"])
def test_a_failed_thruster_does_not_fire(mode):
    env = make(mode, failed_thruster=2)
    heading = START[2]
    forward = np.array([math.cos(heading), math.sin(heading)])
    if mode == "delta_v":
        action = np.array([*(0.004 * forward), 0.0])
    else:
        action = np.array([0, 0, 1, 0, 0, 1, 0, 0])
    *_, info = env.step(action)
    assert info["firing_time"][2] == 0.0
    assert info["firing_time"][5] > 0.0
    period = env.control_dt
    push = 0.004 / 2 if mode == "delta_v" else ROBOT.thrust * period / ROBOT.mass
    assert env.state[3:5] @ forward == pytest.approx(push, rel=1e-2)
    assert env.state[5] > 0.0


def test_mass_thrust_and_inertia_vary_about_the_nominal():
    rng = np.random.default_rng(0)
    drawn = Disturbances(thrust_error=0.05, mass_error=0.02, inertia_error=0.1)
    plants = [drawn.sample(ROBOT, rng) for _ in range(800)]
    masses = np.array([plant.robot.mass for plant in plants]) / ROBOT.mass
    inertias = np.array([plant.robot.inertia for plant in plants]) / ROBOT.inertia
    thrusts = np.array([plant.thrust_scale for plant in plants])
    assert masses.std() == pytest.approx(0.02, rel=0.1)
    assert inertias.std() == pytest.approx(0.1, rel=0.1)
    assert thrusts.mean() == pytest.approx(1.0, abs=5e-3)
    assert thrusts.std() == pytest.approx(0.05 * math.sqrt(1.25), rel=0.1)


def test_a_delayed_command_acts_later():
    prompt, late = make("thrusters"), make("thrusters", delay=3)
    action = np.array([0, 0, 1, 0, 0, 1, 0, 0], dtype=np.float32)
    states = {0: [], 3: []}
    for env, delay in ((prompt, 0), (late, 3)):
        for step in range(10):
            env.step(action if step == 0 else 0 * action)
            states[delay].append(env.state)
    np.testing.assert_allclose(states[3][:3], [START] * 3, atol=1e-12)
    np.testing.assert_allclose(states[3][3:], states[0][:-3], atol=1e-12)


def test_short_pulses_wait_until_they_are_worth_it():
    env = make("thrusters", min_on_time=0.05)
    duties = np.zeros(8, dtype=np.float32)
    duties[[2, 5]] = 0.2
    fired = [env.step(duties)[4]["firing_time"][2] for _ in range(30)]
    pulses = np.diff([0.0, *fired])
    assert pulses[pulses > 1e-9].min() > 0.05 - 1e-9
    assert fired[-1] == pytest.approx(30 * 0.02, abs=0.06)


def test_the_testbed_flies_and_is_seeded():
    def flight(seed):
        env = gym.make("FreeFlyer-v0", action_mode="thrusters", disturbances="testbed")
        env.reset(seed=seed)
        env.action_space.seed(0)
        for _ in range(30):
            observation, *_ = env.step(env.action_space.sample())
        return observation["state"].tobytes()

    assert flight(0) == flight(0)
    assert flight(0) != flight(1)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"position_noise": -1.0}, "position_noise must be a finite number >= 0"),
        ({"table_tilt": math.nan}, "table_tilt must be a finite number >= 0"),
        ({"failed_thruster": 8}, "failed_thruster must be None or 0 to 7"),
        ({"delay": 0.5}, "delay must be an integer >= 0"),
    ],
)
def test_bad_fields(fields, message):
    with pytest.raises(ValueError, match=message):
        Disturbances(**fields)
