"""Tracking a plan with on/off thrusters."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from freeflyer_env import HELD_OUT_SCENES, Obstacles, Problem, Robot, Scenario, sample_problem
from freeflyer_env.constraints import keep_out_depth
from freeflyer_env.control import (
    DisturbanceObserver,
    LQRTracker,
    PIDTracker,
    PulseWidthModulator,
    ReplanningTracker,
    TrackingMPC,
    fly,
    reference_at,
)
from freeflyer_env.control.riccati import double_integrator, solve_riccati
from freeflyer_env.planning import Trajectory, solve_multistart, solve_scp


@pytest.fixture(scope="module")
def planned():
    problem = sample_problem(np.random.default_rng(4), HELD_OUT_SCENES[0])
    return problem, solve_multistart(problem, 4).best.trajectory


@pytest.fixture
def env():
    return gym.make("freeflyer_env:FreeFlyer-v0", action_mode="thrusters", terminate_early=False)


def test_pulses_are_whole_sub_steps_and_right_on_average():
    modulator = PulseWidthModulator(10)
    duties = np.array([0.0, 0.03, 0.1, 0.25, 0.333, 0.5, 0.97, 1.0])
    periods = np.array([modulator.pulses(duties) for _ in range(300)])
    assert periods.shape == (300, 10, 8)
    np.testing.assert_allclose(periods.mean(axis=(0, 1)), duties, atol=1e-3)
    assert not periods[..., 0].any()
    assert periods[..., 7].all()


def test_each_period_has_one_pulse():
    pulses = PulseWidthModulator(10).pulses(np.full(8, 0.4))
    assert (np.abs(np.diff(pulses.astype(int), axis=0)).sum(axis=0) <= 2).all()
    assert (pulses.sum(axis=0) == 4).all()


def test_short_pulses_wait_until_they_are_long_enough():
    modulator = PulseWidthModulator(10, min_sub_steps=3)
    duties = np.array([0.0, 0.02, 0.1, 0.29, 0.3, 0.55, 0.97, 1.0])
    periods = np.array([modulator.pulses(duties) for _ in range(300)])
    on_times = periods.sum(axis=1)
    assert ((on_times == 0) | (on_times >= 3)).all()
    np.testing.assert_allclose(periods.mean(axis=(0, 1)), duties, atol=2e-3)
    np.testing.assert_array_equal(np.unique(on_times[:, 1]), [0, 3])


def test_without_a_least_on_time_pulses_are_as_before():
    plain, least = PulseWidthModulator(10), PulseWidthModulator(10, min_sub_steps=1)
    for duties in np.random.default_rng(0).uniform(-0.1, 1.1, (200, 8)):
        np.testing.assert_array_equal(plain.pulses(duties), least.pulses(duties))


def test_the_modulator_refuses_nonsense():
    with pytest.raises(ValueError, match=r"sub_steps must be at least 1, got 0"):
        PulseWidthModulator(0)
    with pytest.raises(
        ValueError, match=r"min_sub_steps must be from 0 to sub_steps \(10\), got 11"
    ):
        PulseWidthModulator(10, 11)


def test_the_reference_is_continuous_and_ends_in_the_goal(planned):
    problem, trajectory = planned
    times = np.arange(0.0, 40.0, 0.05)
    states = np.array([reference_at(trajectory, t)[0] for t in times])
    np.testing.assert_allclose(states[0], problem.start, atol=1e-12)
    assert np.abs(np.diff(states[:, :2], axis=0)).max() < 0.02
    np.testing.assert_allclose(reference_at(trajectory, 40.0 - 1e-6)[0], problem.goal, atol=1e-6)
    np.testing.assert_allclose(reference_at(trajectory, 99.0)[0], problem.goal, atol=1e-9)
    # A true motion: positions are the integral of velocities, velocities of accelerations.
    middle = np.array([reference_at(trajectory, t + 0.025)[0] for t in times[:-1]])
    np.testing.assert_allclose(np.diff(states[:, :3], axis=0), 0.05 * middle[:, 3:], atol=1e-9)


def test_it_stays_close_to_the_impulsive_plan(planned):
    _, trajectory = planned
    for index in range(trajectory.n_steps):
        reference, _ = reference_at(trajectory, index * trajectory.dt)
        lag = 0.5 * trajectory.dt * np.linalg.norm(trajectory.states[index, 3:5])
        gap = np.linalg.norm(reference[:2] - trajectory.states[index, :2])
        assert gap <= lag + 1e-9


def test_pid_with_the_papers_gains_flies_the_plan(env, planned):
    problem, trajectory = planned
    env.reset(options={"problem": problem})
    calls = []
    flight = fly(env, trajectory, on_step=lambda: calls.append(1))
    assert flight.success
    assert len(calls) == len(flight.duties) == 400
    assert flight.tracking_error < 0.005
    assert flight.final_error[0] < 0.005
    assert flight.contacts == 0
    assert flight.firing_time > 5.0
    assert flight.states.shape == (401, 6)


def test_it_recovers_from_an_offset(env, planned):
    problem, trajectory = planned
    env.reset(options={"problem": problem})
    base = env.unwrapped
    state = base.state
    state[1] += 0.03
    base._world.state = state
    flight = fly(env, trajectory, PIDTracker(base.robot))
    assert flight.final_error[0] < 0.02


def test_bad_use(planned):
    problem, trajectory = planned
    env = gym.make("freeflyer_env:FreeFlyer-v0")
    env.reset(options={"problem": problem})
    with pytest.raises(ValueError, match="needs action_mode='thrusters'"):
        fly(env, trajectory)
    with pytest.raises(ValueError, match=r"PIDTracker.kp must be three numbers >= 0"):
        PIDTracker(Robot(), kp=(1.0, -1.0, 0.0))


def test_replanning_makes_a_new_plan_after_a_push(planned, env):
    problem, plan = planned
    env = gym.make(
        "freeflyer_env:FreeFlyer-v0",
        action_mode="thrusters",
        scenario=problem.scenario,
        terminate_early=False,
    )
    worst = {}
    for tracker in (PIDTracker(problem.scenario.robot), ReplanningTracker(problem)):
        env.reset(options={"problem": problem})

        def push():
            if abs(env.unwrapped.time - 12.0) < 1e-6:
                env.unwrapped.push([-0.04, 0.05, 0.4])

        flight = fly(env, plan, tracker, on_step=push)
        assert flight.success
        assert flight.final_error[0] < 1e-3
        worst[type(tracker)] = flight.tracking_error
    assert worst[ReplanningTracker] < 0.05 < worst[PIDTracker]
    assert len(tracker.results) == 70
    assert all(result.solved for result in tracker.results)
    assert np.median([result.iterations for result in tracker.results]) <= 3
    tracker.reset()
    assert tracker.results == []


def test_replanning_and_push_refuse_nonsense(planned, env):
    with pytest.raises(ValueError, match="period must be positive"):
        ReplanningTracker(planned[0], period=0.0)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="three finite numbers"):
        env.unwrapped.push([1.0, np.nan, 0.0])


def make(scenario, **settings):
    return gym.make(
        "freeflyer_env:FreeFlyer-v0",
        action_mode="thrusters",
        scenario=scenario,
        terminate_early=False,
        **settings,
    )


@pytest.fixture(scope="module")
def beside_a_disc():
    """A straight plan that passes the keep-out disc of an obstacle at 3 cm."""
    radius = 0.2
    centre = [1.75, 1.25 - 1.1 * (radius + 0.15) - 0.03]
    scenario = Scenario(obstacles=Obstacles([centre], [radius]))
    start, goal = [0.3, 1.25, 0.0, 0.0, 0.0, 0.0], [3.2, 1.25, 0.0, 0.0, 0.0, 0.0]
    problem = Problem(scenario, start, goal, 40.0)
    return problem, solve_scp(problem).trajectory


def test_the_riccati_equation_is_solved_and_the_lqr_is_stable():
    robot = Robot()
    a, b = double_integrator(robot, 0.1)
    q, r = np.diag([1.0, 2.0, 3.0, 0.0, 0.5, 0.1]), np.diag([0.1, 1.0, 10.0])
    x = solve_riccati(a, b, q, r)
    gain = np.linalg.solve(r + b.T @ x @ b, b.T @ x @ a)
    np.testing.assert_allclose(a.T @ x @ (a - b @ gain) + q, x, rtol=1e-9, atol=1e-9)
    for dt in (0.01, 0.1, 0.5):
        a, b = double_integrator(robot, dt)
        gain, _ = LQRTracker(robot).design(dt)
        assert np.abs(np.linalg.eigvals(a - b @ gain)).max() < 1.0 - 0.3 * dt
    with pytest.raises(ValueError, match="no stabilising solution"):
        solve_riccati(2.0 * np.eye(6), 0.0 * b, np.eye(6), np.eye(3))


@pytest.mark.parametrize("name", ["LQRTracker", "TrackingMPC"])
def test_lqr_and_mpc_fly_the_plan(planned, name):
    problem, trajectory = planned
    env = make(problem.scenario)
    env.reset(options={"problem": problem})
    tracker = LQRTracker(Robot()) if name == "LQRTracker" else TrackingMPC(problem.scenario)
    flight = fly(env, trajectory, tracker)
    assert flight.success
    assert flight.contacts == 0
    assert flight.rms_error < 2e-4
    assert flight.tracking_error < 1e-3
    assert flight.fuel == pytest.approx(0.2 * flight.firing_time)
    if name == "TrackingMPC":
        assert tracker.failures == 0
        assert 0.0 <= flight.duties.min() <= flight.duties.max() <= 1.0
        env.reset(options={"problem": problem})
        np.testing.assert_array_equal(fly(env, trajectory, tracker).states, flight.states)


def test_observers_and_a_known_delay_halve_the_error_on_the_testbed(planned):
    problem, trajectory = planned
    robot, errors = Robot(), {}
    env = make(problem.scenario, disturbances="testbed")
    trackers = {
        "pid": PIDTracker(robot),
        "lqr": LQRTracker(robot, observer=DisturbanceObserver(robot, delay=1)),
        "mpc": TrackingMPC(problem.scenario, observer=DisturbanceObserver(robot, delay=1)),
    }
    for name, tracker in trackers.items():
        flights = []
        for seed in range(3):
            env.reset(seed=seed, options={"problem": problem})
            flights.append(fly(env, trajectory, tracker))
        assert all(flight.success for flight in flights)
        errors[name] = np.mean([[flight.rms_error, flight.final_error[0]] for flight in flights], 0)
    assert (errors["lqr"] < 0.6 * errors["pid"]).all()
    assert (errors["mpc"] < 0.6 * errors["pid"]).all()


def test_the_observer_finds_the_tilt_and_smooths_noise():
    robot, rng, tilt = Robot(), np.random.default_rng(0), np.array([0.016, -0.008, 0.001])
    observer = DisturbanceObserver(robot, delay=2)
    a, b = double_integrator(robot, 0.1)
    state, noise = np.zeros(6), np.array([1e-3, 1e-3, 2e-3, 1e-3, 1e-3, 4e-3])
    commands, estimates, truth = [np.zeros(8)] * 2, [], []
    for index in range(400):
        ahead = observer.update(state + noise * rng.standard_normal(6), 0.1)
        assert ahead.shape == (6,)
        estimates.append([*observer.state, *observer.disturbance])
        truth.append([*state, *tilt])
        commands.append(robot.allocate(np.array([0.1 * np.sin(0.3 * index), 0.05, 0.0])))
        observer.command(commands[-1])
        wrench = robot.wrench_matrix @ commands[index]
        cos, sin = np.cos(state[2] + 0.05 * state[5]), np.sin(state[2] + 0.05 * state[5])
        wrench[:2] = cos * wrench[0] - sin * wrench[1], sin * wrench[0] + cos * wrench[1]
        state = a @ state + b @ (wrench + tilt)
    errors = np.array(estimates)[100:] - np.array(truth)[100:]
    assert (np.sqrt((errors**2).mean(axis=0))[:6] < 0.7 * noise).all()
    np.testing.assert_allclose(np.array(estimates)[-200:, 6:].mean(axis=0), tilt, atol=1e-3)


def test_the_observer_begins_anew_after_a_push():
    observer = DisturbanceObserver(Robot())
    observer.update(np.zeros(6), 0.1)
    pushed = np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0])
    np.testing.assert_array_equal(observer.update(pushed, 0.1), pushed)


def test_mpc_is_the_lqr_while_no_limit_is_met(beside_a_disc):
    problem, trajectory = beside_a_disc
    state = trajectory.states[0] + [2e-4, -1e-4, 2e-3, 0.0, 1e-4, 0.0]
    held = Trajectory(np.tile(problem.start, (81, 1)), np.zeros((80, 3)), 0.5)
    lqr = LQRTracker(Robot()).duties(state, held, 0.0, 0.1)
    mpc = TrackingMPC(problem.scenario).duties(state, held, 0.0, 0.1)
    np.testing.assert_allclose(mpc, lqr, atol=0.02)
    assert lqr.max() > 0.01


def test_mpc_stays_out_of_a_keep_out_disc_where_others_enter(beside_a_disc):
    problem, trajectory = beside_a_disc
    env = make(problem.scenario)
    lax = (0.05, 0.03, 0.1, 0.1)
    trackers = {
        "pid": PIDTracker(Robot()),
        "lqr": LQRTracker(Robot(), state_scale=lax),
        "mpc": TrackingMPC(problem.scenario, state_scale=lax, margin=0.002),
    }
    depth = {}
    for name, tracker in trackers.items():
        env.reset(options={"problem": problem})

        def push():
            if abs(env.unwrapped.time - 19.0) < 1e-6:
                env.unwrapped.push([0.0, -0.035, 0.0])

        flight = fly(env, trajectory, tracker, on_step=push)
        depth[name] = keep_out_depth(problem.scenario, flight.states[:, :2], flight.times).max()
        assert flight.success
        assert 0.0 <= flight.duties.min() <= flight.duties.max() <= 1.0
    assert depth["mpc"] <= 0.0
    assert depth["pid"] > 1e-3
    assert depth["lqr"] > 1e-3


@pytest.mark.parametrize("state", [[1.75, 0.9, 3.0, 0.3, 0.4, 2.0], [-1.0, 9.0, -9.0, 0, 0, 0]])
def test_mpc_always_has_a_command(beside_a_disc, state):
    problem, trajectory = beside_a_disc
    tracker = TrackingMPC(problem.scenario)
    duties = tracker.duties(np.array(state), trajectory, 19.0, 0.1)
    assert duties.shape == (8,)
    assert 0.0 <= duties.min() <= duties.max() <= 1.0


def test_where_osqp_finds_nothing_the_lqr_commands(beside_a_disc):
    problem, trajectory = beside_a_disc
    mpc, lqr = TrackingMPC(problem.scenario, max_iterations=1), LQRTracker(Robot())
    state = np.array([1.6, 1.3, 0.3, 0.1, -0.05, 0.2])
    for index in range(3):
        time = 19.0 + 0.1 * index
        np.testing.assert_array_equal(
            mpc.duties(state, trajectory, time, 0.1), lqr.duties(state, trajectory, time, 0.1)
        )
    assert mpc.failures == 3
    mpc.reset()
    assert mpc.failures == 0


def test_the_import_loads_no_solver():
    code = "import sys, freeflyer_env.control; print({'osqp', 'scipy', 'piqp'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"


def test_without_osqp_there_is_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "osqp", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "freeflyer-gym\[planning\]"'):
        TrackingMPC(Scenario())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: LQRTracker(Robot(), state_scale=(1, 1, 1, 0)), "LQRTracker.state_scale must be 4"),
        (lambda: LQRTracker(Robot(), wrench_scale=(1,)), "LQRTracker.wrench_scale must be 2"),
        (lambda: TrackingMPC(Scenario(), horizon=0.0), "TrackingMPC.horizon must be a positive"),
        (lambda: TrackingMPC(Scenario(), slack_price=-1.0), "TrackingMPC.slack_price must be a"),
        (lambda: TrackingMPC(Scenario(), margin=-0.1), "TrackingMPC.margin must be a finite"),
        (lambda: TrackingMPC(Scenario(), max_iterations=0), "max_iterations must be at least 1"),
        (lambda: DisturbanceObserver(Robot(), delay=-1), "delay must be an integer >= 0, got -1"),
        (lambda: DisturbanceObserver(Robot(), walk=(0, 1)), "DisturbanceObserver.walk must be 2"),
        (lambda: DisturbanceObserver(Robot(), noise=(1, 1)), "DisturbanceObserver.noise must be 4"),
    ],
)
def test_bad_settings_are_one_clear_line(build, message):
    with pytest.raises(ValueError, match=message) as caught:
        build()
    assert "\n" not in str(caught.value)
    assert "got" in str(caught.value)


@pytest.mark.parametrize("follower", ["lqr", "mpc"])
def test_any_tracker_follows_what_is_planned_anew(planned, follower):
    problem, trajectory = planned
    inner = LQRTracker(Robot()) if follower == "lqr" else TrackingMPC(problem.scenario)
    env = make(problem.scenario)
    env.reset(options={"problem": problem})
    flight = fly(env, trajectory, ReplanningTracker(problem, period=4.0, follower=inner))
    assert flight.success
    assert flight.tracking_error < 5e-3
