"""FreeFlyer-v0 as Gymnasium and its users see it."""

import copy
import pickle
import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from freeflyer_env import (
    HELD_OUT_SCENES,
    Obstacles,
    Problem,
    Robot,
    Scenario,
    dynamics,
    sample_problem,
)
from freeflyer_env.env import ERROR_WEIGHTS
from freeflyer_env.planning import solve_multistart
from freeflyer_env.spaces import obstacle_mask

MODES = ["delta_v", "thrusters", "on_off"]


def make(**arguments):
    return gym.make("freeflyer_env:FreeFlyer-v0", **arguments)


@pytest.mark.parametrize("mode", MODES)
def test_gymnasiums_checker_has_nothing_to_say(mode):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(action_mode=mode, final_time=5.0).unwrapped)


@pytest.mark.parametrize("mode", MODES)
def test_same_seed_same_bytes(mode):
    def episode():
        env = make(action_mode=mode)
        env.action_space.seed(3)
        observations = [env.reset(seed=5)[0]]
        for _ in range(30):
            observations.append(env.step(env.action_space.sample())[0])
        return b"".join(o[key].tobytes() for o in observations for key in sorted(o))

    assert episode() == episode()


@pytest.mark.parametrize("mode", MODES)
def test_observations_are_in_the_space_fresh_and_float32(mode):
    env = make(action_mode=mode)
    first, _ = env.reset(seed=0)
    kept = copy.deepcopy(first)
    for _ in range(20):
        observation, *_ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert all(value.dtype == np.float32 for value in observation.values())
    assert all(np.array_equal(first[key], kept[key]) for key in first)


def test_delta_v_reproduces_the_impulsive_model():
    env = make(terminate_early=False)
    problem = sample_problem(np.random.default_rng(2))
    env.reset(options={"problem": problem})
    controls = np.float32(0.002 * np.random.default_rng(0).normal(size=(12, 3)) * [1, 1, 0.1])
    states = [env.unwrapped.state]
    for control in controls:
        env.step(control)
        states.append(env.unwrapped.state)
    padded = np.vstack([controls.astype(np.float64), np.zeros((1, 3))])
    expected = dynamics.rollout(problem.start, padded, 0.5, env.unwrapped.robot)
    np.testing.assert_allclose(states, expected[:-1], atol=1e-9)


def test_a_plan_flown_open_loop_ends_in_success():
    problem = sample_problem(np.random.default_rng(3), HELD_OUT_SCENES[0])
    plan = solve_multistart(problem, 4).best
    env = make(terminate_early=False)
    env.reset(options={"problem": problem})
    rewards = []
    for control in np.float32(plan.trajectory.controls):
        observation, reward, terminated, truncated, info = env.step(control)
        rewards.append(reward)
    assert terminated
    assert not truncated
    assert info["is_success"]
    assert info["contacts"]["count"] == 0
    assert sum(rewards) == pytest.approx(1.0 - plan.cost, abs=1e-6)
    assert info["cost"] == pytest.approx(plan.cost, abs=1e-6)
    np.testing.assert_allclose(observation["state"], problem.goal, atol=1e-5)
    assert observation["time_to_go"] == 0.0


def test_without_success_the_episode_is_truncated_at_the_final_time():
    for mode, steps in (("delta_v", 10), ("thrusters", 50)):
        env = make(action_mode=mode, final_time=5.0)
        env.reset(seed=1)
        for step in range(steps):
            _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
            assert truncated == (step == steps - 1)
            assert not terminated
        assert not info["is_success"]


def test_impulses_beyond_reach_are_scaled_down():
    env = make()
    env.reset(options={"problem": sample_problem(np.random.default_rng(0), n_obstacles=0)})
    base = env.unwrapped
    limit = 2 * base.robot.delta_v_max(0.5)
    heading = base.state[2]
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    env.step(np.float32(1.0005 * limit * forward))
    assert np.hypot(*base.state[3:5]) == pytest.approx(1.0005 * limit, rel=1e-5)
    before = base.state[3:5]
    env.step(np.float32(-1.2 * limit * forward))
    assert np.hypot(*(base.state[3:5] - before)) == pytest.approx(limit, rel=1e-5)


def test_thrusters_push_where_they_should():
    env = make(action_mode="thrusters", scenario=[])
    problem = Problem(env.unwrapped.scenario, [1.5, 1.2, 0, 0, 0, 0], [3.2, 1.2, 0, 0, 0, 0], 5.0)
    env.reset(options={"problem": problem})
    forward = np.zeros(8, dtype=np.float32)
    forward[[2, 5]] = 1.0
    for _ in range(10):
        _, reward, _, _, info = env.step(forward)
    state = env.unwrapped.state
    np.testing.assert_allclose(state[3:], [0.4 / 16.0, 0, 0], atol=1e-12)
    assert state[0] == pytest.approx(1.5 + 0.5 * 0.4 / 16.0, abs=1e-9)
    np.testing.assert_allclose(info["firing_time"], forward * 1.0)
    assert reward == pytest.approx(-0.4 * 0.1 / 16.0)


def test_contacts_are_reported():
    env = make(scenario=[[2.0, 1.2, 0.2]])
    problem = Problem(
        env.unwrapped.scenario, [1.6, 1.2, 0, 0.05, 0, 0], [3.2, 1.2, 0, 0, 0, 0], 5.0
    )
    env.reset(options={"problem": problem})
    seen = [env.step(np.zeros(3, dtype=np.float32))[4]["contacts"] for _ in range(4)]
    assert any(contact["with"] == [0] for contact in seen)


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("mode", MODES)
def test_copies_go_on_identically(clone, mode):
    env = make(action_mode=mode).unwrapped
    env.reset(seed=4)
    actions = [env.action_space.sample() for _ in range(10)]
    for action in actions[:5]:
        env.step(action)
    twin = clone(env)
    for action in actions[5:]:
        first, second = env.step(action), twin.step(action)
        np.testing.assert_array_equal(first[0]["state"], second[0]["state"])
        assert first[1:4] == second[1:4]
    np.testing.assert_array_equal(env.reset()[0]["goal"], twin.reset()[0]["goal"])


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("sub_steps", [1, 10])
@pytest.mark.parametrize(
    ("restitution", "friction"), [(0.0, 0.5), (1.0, 0.0)], ids=["plastic", "elastic"]
)
def test_copies_made_during_a_contact_go_on_identically(clone, sub_steps, restitution, friction):
    """Chipmunk's contacts hold more than the state: an impulse cache, a push-out velocity."""
    surface = {"restitution": restitution, "friction": friction}
    env = make(scenario=[[2.0, 1.2, 0.2]], sub_steps=sub_steps, **surface).unwrapped
    into_the_corner = [0.3, 0.3, 0.2, -0.2, -0.15, 0.3]
    env.reset(
        options={"problem": Problem(env.scenario, into_the_corner, [3.2, 1.2, 0, 0, 0, 0], 40.0)}
    )
    action, touched = np.array([-0.012, -0.01, 0.0005], dtype=np.float32), 0
    for _ in range(70):
        twin = clone(env)
        first, second = env.step(action), twin.step(action)
        touched += bool(first[4]["contacts"]["with"])
        np.testing.assert_array_equal(env.state, twin.state)
        assert first[4]["contacts"] == second[4]["contacts"]
    assert touched >= 3


def test_problems_can_be_given_as_mappings_or_observations():
    problem = sample_problem(np.random.default_rng(7))
    env = make()
    first, _ = env.reset(options={"problem": problem.to_dict()})
    again, _ = env.reset(options={"problem": first})
    assert all(np.array_equal(first[key], again[key]) for key in first)
    np.testing.assert_array_equal(env.unwrapped.problem.start, problem.start)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"action_mode": "thruster"}, "Did you mean 'thrusters'"),
        ({"scenario": "nominl"}, "Did you mean 'nominal'"),
        ({"final_time": 0.7}, "multiple of dt"),
        ({"sub_steps": 0}, "sub_steps must be at least 1"),
        ({"goal_tolerance": (0.1, 0.1, 0.1)}, "four positive numbers"),
        ({"restitution": 2.0}, "restitution must be in"),
        ({"scenario": "nominal", "max_obstacles": 2}, "at least the scene's 4"),
        ({"final_time": 300.0}, "at most 200 s"),
        ({"scenario": [[4.0, 1.0, 0.1]]}, "obstacles is outside the observation space"),
        ({"render_mode": "ansi"}, "render_mode must be None, 'rgb_array' or 'human'"),
        ({"reward": "dens"}, "Did you mean 'dense'"),
        ({"observation": ("state", "lidr")}, "Did you mean 'lidar'"),
        ({"observation": ()}, "observation must be one of"),
        ({"n_obstacles": (3, 2)}, "n_obstacles must be a number >= 0 or a range"),
        ({"obstacle_speed": 2.0}, r"obstacle_speed must be in \[0, 1\] m/s"),
        ({"image_size": (4, 100)}, "image_size must be"),
        ({"lidar_rays": 0}, "lidar_rays must be at least 1"),
        ({"disturbances": "test"}, "disturbances must be 'testbed'"),
        ({"disturbances": {"position_nose": 1.0}}, "Did you mean 'position_noise'"),
        ({"disturbances": {"delay": -1}}, "delay must be an integer >= 0"),
        ({"disturbances": {"mass_error": 0.5}}, "mass_error is relative and at most 0.2"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode='ansi'")
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments).reset()


def test_bad_problems_are_refused_in_one_line():
    env = make()
    inside = {"start": [1.0, 1.0, 0, 0, 0, 0], "goal": [3.2, 1, 0, 0, 0, 0], "final_time": 40.0}
    with pytest.raises(ValueError, match="inside the keep-out zone of obstacle 0"):
        env.reset(options={"problem": {**inside, "obstacles": [[1.1, 1.0, 0.1]]}})
    with pytest.raises(ValueError, match="max_obstacles=5"):
        env.reset(
            options={
                "problem": {**inside, "obstacles": [[2.0, 0.2 + i / 2, 0.05] for i in range(5)]}
            }
        )
    with pytest.raises(ValueError, match="at most 200 s"):
        env.reset(options={"problem": {**inside, "obstacles": [], "final_time": 300.0}})
    with pytest.raises(ValueError, match="start is outside the observation space"):
        env.reset(options={"problem": {**inside, "obstacles": [], "start": [1, 1, 0, 50, 0, 0]}})
    with pytest.raises(ValueError, match="a Problem or a mapping, got list"):
        env.reset(options={"problem": [1, 2]})
    with pytest.raises(ValueError, match=r"only the option 'problem', got \['problm'\]"):
        env.reset(options={"problm": inside})
    light = Scenario(robot=Robot(mass=10.0), obstacles=Obstacles.from_rows([]))
    other = sample_problem(np.random.default_rng(0), light)
    with pytest.raises(ValueError, match=r"robot is .* scenario=problem.scenario"):
        env.reset(options={"problem": other})


def test_a_refused_problem_leaves_the_episode_as_it_was():
    env = make()
    first, _ = env.reset(seed=0)
    bad = {**first, "state": [9.0, 1, 0, 0, 0, 0]}
    with pytest.raises(ValueError, match="off the table"):
        env.reset(options={"problem": bad})
    after, *_ = env.step(np.zeros(3))
    np.testing.assert_array_equal(after["state"], first["state"])
    np.testing.assert_array_equal(after["obstacles"], first["obstacles"])


def test_arguments_can_be_stored_in_a_spec():
    env = make(action_mode="on_off", scenario=[[2.0, 1.2, 0.2]], goal_tolerance=(0.1, 0.1, 0.1, 1))
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    again = gym.make(spec)
    assert again.observation_space == env.observation_space
    assert again.action_space == env.action_space
    np.testing.assert_array_equal(again.reset(seed=3)[0]["goal"], env.reset(seed=3)[0]["goal"])


def test_without_contacts_the_episode_ends_where_the_table_does():
    env = make(scenario=[[1.0, 1.2, 0.2]], contacts=False)
    scenario = env.unwrapped.scenario
    problem = Problem(scenario, [0.45, 1.2, 0, 0.2, 0, 0], [3.2, 1.2, 0, 0, 0, 0], 40.0)
    env.reset(options={"problem": problem})
    truncated, steps = False, 0
    while not truncated:
        observation, _, terminated, truncated, info = env.step(np.zeros(3))
        assert env.observation_space.contains(observation)
        assert not terminated
        assert info["contacts"]["count"] == 0
        steps += 1
    assert steps == 31
    assert env.unwrapped.state[0] == pytest.approx(3.55)


def test_the_propellant_of_the_thruster_modes_is_the_cost():
    for mode, action in (("thrusters", np.full(8, 0.25)), ("on_off", np.eye(8)[2])):
        env = make(action_mode=mode)
        env.reset(seed=0)
        rewards = [env.step(action.astype(env.action_space.dtype))[1] for _ in range(20)]
        info = env.step(np.zeros(8, dtype=env.action_space.dtype))[4]
        expected = 0.2 / 16.0 * 0.1 * 20 * action.sum()
        assert -sum(rewards) == pytest.approx(expected)
        assert info["cost"] == pytest.approx(expected)
        assert 0.2 / 16.0 * info["firing_time"].sum() == pytest.approx(expected)


def test_bad_actions_and_calls():
    env = make().unwrapped
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(np.zeros(3))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="finite numbers"):
        env.step(np.array([np.nan, 0, 0]))
    with pytest.raises(ValueError, match=r"must be \(3,\)"):
        env.step(np.zeros(8))


def test_the_picture_changes_with_the_plan():
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    plain = env.render()
    assert plain.dtype == np.uint8
    assert plain.ndim == 3
    env.unwrapped.set_plan(np.array([[0.5, 0.5, 0, 0, 0, 0], [3.0, 2.0, 0, 0, 0, 0]]))
    assert (env.render() != plain).any()


def test_fewer_obstacles_than_usual():
    observation, _ = make(max_obstacles=2).reset(seed=0)
    assert observation["obstacles"].shape == (2, 3)
    assert (observation["obstacles"][:, 2] > 0).all()


def test_rendering_survives_another_environments_quit():
    import pygame

    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    pygame.quit()
    np.testing.assert_array_equal(env.render(), before)


def test_success_is_paid_once():
    problem = sample_problem(np.random.default_rng(0), n_obstacles=0)
    there = Problem(problem.scenario, problem.goal, problem.goal, 5.0)
    env = make().unwrapped
    env.reset(options={"problem": there})
    assert env.step(np.zeros(3))[1:3] == (1.0, True)
    with pytest.warns(UserWarning, match="after the episode's end"):
        assert env.step(np.zeros(3))[1] == 0.0


def test_moving_obstacles_need_an_environment_made_for_them():
    obstacles = Obstacles(np.array([[1.5, 1.0]]), [0.2], [[0.0, 0.1]])
    problem = Problem(Scenario(obstacles), [0.3, 1, 0, 0, 0, 0], [3.2, 1, 0, 0, 0, 0])
    with pytest.raises(ValueError, match="moving_obstacles=True"):
        make().reset(options={"problem": problem})
    observation, _ = make(moving_obstacles=True).reset(options={"problem": problem})
    np.testing.assert_allclose(observation["obstacles"][0], [1.5, 1.0, 0.2, 0.0, 0.1], atol=1e-6)


def test_observed_obstacles_move_with_those_on_the_table():
    track = [[0.0, 1.5, 1.0], [10.0, 1.5, 2.0], [15.0, 2.0, 2.0]]
    obstacles = Obstacles.along([track], [0.2])
    env = make(scenario=Scenario(obstacles), final_time=20.0, observation=("state", "lidar"))
    env.reset(seed=0)
    for step in range(1, 41):
        observation = env.step(np.zeros(3))[0]
        expected = obstacles.centres_at(0.5 * step)[0]
        np.testing.assert_allclose(observation["obstacles"][0, :2], expected, atol=1e-6)
        assert env.observation_space.contains(observation)
    assert not observation["obstacles"][0, 3:].any()
    assert (
        Problem.from_dict(env.unwrapped.problem.to_dict()).scenario.obstacles.waypoints is not None
    )


def test_random_obstacles_vary_in_number_and_move():
    env = make(n_obstacles=(0, 6), obstacle_speed=0.05)
    counts, speeds = set(), []
    for seed in range(40):
        observation, _ = env.reset(seed=seed)
        assert env.observation_space.contains(observation)
        mask = obstacle_mask(observation["obstacles"])
        counts.add(int(mask.sum()))
        speeds += np.linalg.norm(observation["obstacles"][mask, 3:], axis=1).tolist()
    assert counts == set(range(7))
    assert 0.0 < max(speeds) <= 0.05 + 1e-6


def test_contact_may_end_the_episode():
    problem = Problem(
        Scenario(Obstacles.from_rows([[1.0, 1.2, 0.2]])),
        [0.4, 1.2, 0, 0.2, 0, 0],
        [3.2, 1.2, 0, 0, 0, 0],
    )
    env = make(terminate_on_contact=True)
    env.reset(options={"problem": problem})
    for _ in range(3):
        *_, terminated, truncated, info = env.step(np.zeros(3))
    assert terminated
    assert not truncated
    assert not info["is_success"]
    assert info["contacts"]["with"] == [0]


def test_the_dense_reward_telescopes():
    """Shaping adds up to the fall of the potential, whatever way is flown."""
    returns = {}
    for reward in ("paper", "dense"):
        env = make(reward=reward, final_time=10.0)
        env.reset(seed=0)
        env.action_space.seed(0)
        error = np.array(env.unwrapped._goal_error(env.unwrapped.state.tolist()))
        steps = [env.step(env.action_space.sample()) for _ in range(20)]
        returns[reward] = sum(step[1] for step in steps)
        fall = (error - np.array(steps[-1][4]["goal_error"])) @ ERROR_WEIGHTS
    assert returns["dense"] - returns["paper"] == pytest.approx(fall, abs=1e-9)


@pytest.mark.parametrize("mode", MODES)
def test_a_snapshot_replays_bit_for_bit(mode):
    """Also from a moment right after a contact, and with noise."""
    scenario = [[0.62, 0.7, 0.2], [0.62, 1.2, 0.2], [0.62, 1.8, 0.2]]
    env = make(
        action_mode=mode, scenario=scenario, disturbances="testbed", observation=("state", "lidar")
    ).unwrapped
    problem = Problem(
        replace(env.scenario), [0.25, 0.95, 0, 0.3, 0.1, 0.3], [3.2, 1.2, 0, 0, 0, 0], 40.0
    )
    env.reset(seed=1, options={"problem": problem})
    env.action_space.seed(1)
    actions = [env.action_space.sample() for _ in range(60)]

    def fly(actions):
        results = [env.step(action) for action in actions]
        observed = b"".join(v.tobytes() for r in results for v in r[0].values())
        return observed, [r[1] for r in results], env.state.tobytes()

    contacts, snapshots = 0, []
    for action in actions[:20]:
        snapshots.append((env.save(), contacts))
        contacts += env.step(action)[4]["contacts"]["count"]
    assert contacts > 0
    for start, (snapshot, _) in enumerate(snapshots):
        env.restore(snapshot)
        first = fly(actions[start:])
        env.restore(snapshot)
        assert fly(actions[start:]) == first
    with pytest.raises(ValueError, match=r"what save\(\) gave"):
        env.restore({})


def test_the_window_shows_the_picture(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = make(render_mode="human", final_time=1.0)
    env.metadata["render_fps"] = 1000
    env.reset(seed=0)
    env.step(np.zeros(3))
    assert env.render() is None
    pickle.loads(pickle.dumps(env.unwrapped))
    env.close()


def test_frames_are_collected_and_recorded(tmp_path):
    env = make(render_mode="rgb_array_list", final_time=2.0)
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros(3))
    assert len(env.render()) == 5
    pytest.importorskip("moviepy")
    env = gym.wrappers.RecordVideo(make(render_mode="rgb_array", final_time=2.0), str(tmp_path))
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros(3))
    env.close()
    assert [path.suffix for path in tmp_path.glob("*.mp4")] == [".mp4"]


@pytest.mark.parametrize("mode", MODES)
def test_a_delayed_command_is_the_one_that_was_given(mode):
    """Whoever steps may use one array again and again."""

    def fly(reuse):
        env = make(action_mode=mode, disturbances={"delay": 2})
        env.reset(seed=0)
        env.action_space.seed(0)
        buffer = np.zeros_like(env.action_space.sample())
        for _ in range(20):
            action = env.action_space.sample()
            buffer[...] = action
            env.step(buffer if reuse else action)
        return env.unwrapped.state

    np.testing.assert_array_equal(fly(True), fly(False))


def test_whoever_is_pushed_off_the_table_is_truncated():
    env = make(sub_steps=1, scenario=[])
    start, goal = [0.3, 1.0, 0, -2.5, 0, 0], [3, 1.0, 0, 0, 0, 0]
    env.reset(options={"problem": Problem(env.unwrapped.scenario, start, goal)})
    assert env.step(np.zeros(3))[3]


def test_a_crash_is_no_success():
    goal = [0.2, 1.0, 0, 0, 0, 0]
    problem = Problem(Scenario(Obstacles.from_rows([])), [0.2, 1.0, 0, -0.3, 0, 0], goal)
    env = make(terminate_on_contact=True, goal_tolerance=(1.0, 1.0, 1.0, 1.0))
    env.reset(options={"problem": problem})
    _, reward, terminated, _, _ = env.step(np.zeros(3))
    assert terminated
    assert reward == 0.0


def test_a_snapshot_of_another_environment_is_refused():
    env, other = make().unwrapped, make(max_obstacles=8).unwrapped
    for each in (env, other):
        each.reset(seed=0)
    with pytest.raises(ValueError, match="made with the same arguments"):
        other.restore(env.save())
