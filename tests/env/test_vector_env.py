"""The vector form of FreeFlyer-v0 against the single environment."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from freeflyer_env import Problem, Scenario, sample_problem

MODES = ["delta_v", "thrusters", "on_off"]
STEPS = {"delta_v": 80, "thrusters": 150, "on_off": 150}


def make(num_envs=4, **arguments):
    return gym.make_vec(
        "FreeFlyer-v0", num_envs, vectorization_mode="vector_entry_point", **arguments
    )


def random_problems(count, speed=0.0):
    """Random problems; with a speed, the robot starts moving and soon meets something."""
    rng, problems = np.random.default_rng(9), []
    for seed in range(count):
        problem = sample_problem(np.random.default_rng(seed))
        start = problem.start.copy()
        start[3:] = speed * rng.uniform([0.5, -1.0, -3.0], [1.0, 1.0, 3.0])
        problems.append(Problem(problem.scenario, start, problem.goal, problem.final_time))
    return problems


def fly_both(problems, mode, steps, gain=1, **arguments):
    """What both forms tell at each step under the same random actions, episode ends included."""
    arguments = {"action_mode": mode, "success_reward": 3.0, **arguments}
    batch = make(len(problems), autoreset_mode=AutoresetMode.DISABLED, **arguments)
    batch.reset(options={"problems": problems})
    batch.action_space.seed(1)
    alone = [gym.make("FreeFlyer-v0", **arguments).unwrapped for _ in problems]
    for env, problem in zip(alone, problems):
        env.reset(options={"problem": problem})
    for _ in range(steps):
        actions = gain * batch.action_space.sample()
        together = batch.step(actions)
        yield together, batch.unwrapped.states, [e.step(a) for e, a in zip(alone, actions)], alone
        if (together[2] | together[3]).any():
            return


def check_agreement(together, states, single, alone):
    observations, rewards, terminated, truncated, infos = together
    for index, (observation, reward, *ends, info) in enumerate(single):
        np.testing.assert_allclose(states[index], alone[index].state, atol=1e-9)
        for key, value in observation.items():
            np.testing.assert_allclose(observations[key][index], value, atol=1e-5)
        assert rewards[index] == pytest.approx(reward, abs=1e-9)
        assert [terminated[index], truncated[index]] == ends
        for key in ("goal_error", "cost", "fuel", "firing_time", "is_success"):
            np.testing.assert_allclose(infos[key][index], info[key], atol=1e-9)
        contacts, touched = info["contacts"], infos["contacts"]["with"][index]
        assert infos["contacts"]["count"][index] == contacts["count"]
        assert infos["contacts"]["impulse"][index] == pytest.approx(contacts["impulse"], rel=1e-6)
        names = [*range(len(touched) - 1), "wall"]
        assert {name for name, hit in zip(names, touched) if hit} == set(contacts["with"])


@pytest.mark.parametrize("reward", ["paper", "dense"])
@pytest.mark.parametrize("mode", MODES)
def test_free_flight_is_that_of_the_single_environment(mode, reward):
    steps, arguments = 0, {"reward": reward, "contacts": False}
    gain = np.float32(0.1) if mode == "delta_v" else 1  # stays on the table longer
    for told in fly_both(random_problems(4), mode, STEPS[mode], gain, **arguments):
        check_agreement(*told)
        steps += 1
    assert steps > 60


@pytest.mark.parametrize(
    ("mode", "friction", "restitution", "sub_steps"),
    [
        ("delta_v", 0.0, 0.5, 10),
        ("delta_v", 0.3, 0.0, 10),
        ("delta_v", 0.3, 0.8, 2),
        ("thrusters", 0.3, 0.2, 10),
        ("on_off", 0.0, 0.5, 10),
    ],
)
def test_contacts_are_those_of_the_single_environment(mode, friction, restitution, sub_steps):
    contacts = 0
    arguments = {"friction": friction, "restitution": restitution, "sub_steps": sub_steps}
    for told in fly_both(random_problems(15, 0.4), mode, STEPS[mode], **arguments):
        check_agreement(*told)
        contacts += told[0][4]["contacts"]["count"].sum()
    assert contacts > 15


def test_several_contacts_at_once_are_those_of_the_single_environment():
    """A corner, and a gap between two discs that is too narrow."""
    scenario = Scenario.named("nominal")
    gap = {"obstacles": [[1.2, 1.0, 0.15], [1.2, 1.4, 0.15]], "final_time": 10.0}
    corner = {"obstacles": [], "final_time": 10.0}
    goal = [3.2, 1.2, 0, 0, 0, 0]
    problems = [
        Problem.from_dict({"start": start, "goal": goal, **rest}, scenario)
        for start, rest in (
            ([0.7, 1.2, 0, 0.2, 0.003, 0.5], gap),
            ([0.7, 1.2, 0, 0.2, 0, 0], gap),
            ([0.3, 0.3, 0, -0.1, -0.1, 0.5], corner),
            ([0.3, 0.3, 0, -0.1, -0.11, 0], corner),
        )
    ]
    contacts = np.zeros(4)
    for told in fly_both(problems, "delta_v", 20, friction=0.5, restitution=0.1):
        check_agreement(*told)
        contacts += told[0][4]["contacts"]["count"]
    assert (contacts >= 2).all()


@pytest.mark.parametrize("terminate_early", [True, False])
def test_success_ends_and_pays_as_in_the_single_environment(terminate_early):
    there = sample_problem(np.random.default_rng(0), n_obstacles=0)
    away = [
        Problem(there.scenario, there.goal - [d, 0, 0, 0, 0, 0], there.goal, 5.0) for d in (0, 1)
    ]
    env = make(2, terminate_early=terminate_early, autoreset_mode="Disabled")
    env.reset(options={"problems": away})
    for step in range(1, 11):
        _, rewards, terminated, truncated, infos = env.step(np.zeros((2, 3), np.float32))
        at_end = step == 10
        np.testing.assert_array_equal(infos["is_success"], [True, False])
        np.testing.assert_array_equal(terminated, [terminate_early or at_end, False])
        np.testing.assert_array_equal(truncated, [False, at_end])
        np.testing.assert_array_equal(rewards, [terminated[0], 0.0])
        if terminated[0]:
            break


def test_contact_may_end_the_episode():
    env = make(2, terminate_on_contact=True, scenario=[[1.0, 1.2, 0.2]], final_time=5.0)
    starts = ([0.4, 1.2, 0, 0.2, 0, 0], [0.4, 1.2, 0, 0, 0, 0])
    base = env.unwrapped.single_observation_space
    assert base["obstacles"].shape == (4, 3)
    env.reset(
        options={
            "problems": [
                {"start": s, "goal": [3.2, 1.2, 0, 0, 0, 0], "obstacles": [[1.0, 1.2, 0.2]]}
                | {"final_time": 5.0}
                for s in starts
            ]
        }
    )
    steps = [env.step(np.zeros((2, 3), np.float32)) for _ in range(3)]
    ends = [step[2] for step in steps]
    np.testing.assert_array_equal(ends, [[False, False], [False, False], [True, False]])


def test_a_crash_is_no_success():
    env = make(1, terminate_on_contact=True, goal_tolerance=(1.0, 1.0, 1.0, 1.0), scenario=[])
    start, goal = [0.2, 1.0, 0, -0.3, 0, 0], [0.2, 1.0, 0, 0, 0, 0]
    problem = {"start": start, "goal": goal, "obstacles": [], "final_time": 5.0}
    env.reset(options={"problem": problem})
    _, rewards, terminated, _, _ = env.step(np.zeros((1, 3), np.float32))
    assert terminated[0]
    assert rewards[0] == 0.0


@pytest.mark.parametrize("mode", MODES)
def test_spaces_and_fresh_memory(mode):
    env = make(6, action_mode=mode, final_time=3.0, n_obstacles=(0, 6))
    assert env.action_space.shape == (6, *env.single_action_space.shape)
    told, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(50):
        kept = copy.deepcopy(told)
        following, *_, infos = env.step(env.action_space.sample())
        assert env.observation_space.contains(following)
        assert all(value.dtype == np.float32 for value in following.values())
        assert all(np.array_equal(told[key], kept[key]) for key in told)
        for value in (*following.values(), infos["cost"], infos["firing_time"]):
            assert value.flags.c_contiguous
            value[...] = 1.0  # must not reach the environment
        told = following
    assert not (env.unwrapped.states == 1.0).all()


def test_same_seed_same_batch():
    def run(seed):
        env = make(8, final_time=2.0)
        env.action_space.seed(0)
        observations = [env.reset(seed=seed)[0]]
        observations += [env.step(env.action_space.sample())[0] for _ in range(12)]
        return b"".join(o[key].tobytes() for o in observations for key in sorted(o))

    assert run(3) == run(3)
    assert run(3) != run(4)
    assert run(list(range(8))) == run(list(range(8)))
    assert run(list(range(8))) != run(list(range(1, 9)))


def test_random_problems_have_the_single_environments_distribution():
    count = 1500
    env = make(count, n_obstacles=(0, 5), max_obstacles=6)
    observations, _ = env.reset(seed=0)
    rng = np.random.default_rng(1)
    problems = [sample_problem(rng, n_obstacles=int(rng.integers(0, 6))) for _ in range(count)]
    singly = {
        "state": np.array([problem.start for problem in problems]),
        "goal": np.array([problem.goal for problem in problems]),
        "obstacles": np.zeros((count, 6, 3)),
    }
    for rows, problem in zip(singly["obstacles"], problems):
        rows[: len(problem.scenario.obstacles)] = problem.scenario.obstacles.rows()

    def statistics(told):
        rows, start, goal = told["obstacles"], told["state"], told["goal"]
        return np.column_stack(
            [
                *(start[:, :3], goal[:, :3], start[:, :3] ** 2, goal[:, :3] ** 2),
                *((rows[..., 2] > 0).sum(axis=1), rows.sum(axis=1), (rows**2).sum(axis=1)),
            ]
        )

    ours, theirs = (statistics(told) for told in (observations, singly))
    error = np.sqrt((ours.var(axis=0) + theirs.var(axis=0)) / count)
    assert (np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) < 4.0 * error).all()
    for index in range(50):
        told = {key: value[index] for key, value in observations.items()}
        Problem.from_dict(told).require_valid()


def test_next_step_autoreset():
    env = make(3, final_time=1.0)
    env.reset(seed=0, options={"reset_mask": np.ones(3, dtype=bool)})
    zeros = np.zeros((3, 3), np.float32)
    env.step(zeros)
    last, _, _, truncated, _ = env.step(zeros)
    assert truncated.all()
    first, rewards, terminated, truncated, infos = env.step(zeros + 0.01)
    for value in (rewards, terminated, truncated, infos["cost"]):
        assert not value.any()
    assert (first["goal"] != last["goal"]).any()
    np.testing.assert_array_equal(first["time_to_go"], 1.0)
    np.testing.assert_array_equal(env.unwrapped.states[:, 3:], 0.0)
    assert not env.step(zeros)[3].any()


def test_same_step_autoreset():
    env = make(3, final_time=1.0, autoreset_mode=AutoresetMode.SAME_STEP)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.reset(seed=0)
    zeros = np.zeros((3, 3), np.float32)
    before, *_, infos = env.step(zeros + 0.001)
    assert "final_obs" not in infos
    first, _, _, truncated, infos = env.step(zeros)
    assert truncated.all()
    assert infos["_final_obs"].all()
    assert infos["_final_info"].all()
    for index in range(3):
        np.testing.assert_array_equal(infos["final_obs"][index]["goal"], before["goal"][index])
        assert infos["final_obs"][index]["time_to_go"] == 0.0
    assert (infos["final_info"]["cost"] > 0.0).all()
    assert infos["final_info"]["_cost"].all()
    np.testing.assert_array_equal(infos["cost"], 0.0)
    np.testing.assert_array_equal(first["time_to_go"], 1.0)


def test_without_autoreset_some_are_reset_by_hand():
    env = make(3, final_time=1.0, autoreset_mode="Disabled")
    env.reset(seed=0)
    zeros = np.zeros((3, 3), np.float32)
    env.step(zeros)
    ended = env.step(zeros)[0]
    with pytest.raises(gym.error.ResetNeeded, match=r"reset_mask"):
        env.step(zeros)
    mask = np.array([True, False, True])
    told, infos = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(infos["_cost"], mask)
    np.testing.assert_array_equal((told["goal"] == ended["goal"]).all(axis=1), ~mask)
    env.reset(options={"reset_mask": ~mask})
    env.step(zeros)


def test_wrappers_of_gymnasium_work():
    env = gym.wrappers.vector.RecordEpisodeStatistics(make(3, final_time=1.0))
    env = gym.wrappers.vector.DictInfoToList(env)
    env.reset(seed=0)
    infos = [env.step(env.action_space.sample())[4] for _ in range(2)][-1]
    assert [info["episode"]["l"] for info in infos] == [2, 2, 2]


def test_copies_go_on_identically():
    env = make(5, action_mode="thrusters", final_time=1.0).unwrapped
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(30)]
    for action in actions[:5]:
        env.step(action)
    twin = pickle.loads(pickle.dumps(env))
    for action in actions[5:]:
        for one, other in zip(env.step(action)[0].values(), twin.step(action)[0].values()):
            np.testing.assert_array_equal(one, other)


def test_pictures():
    pytest.importorskip("pygame")
    env = make(2, render_mode="rgb_array")
    env.reset(seed=0)
    first, second = env.render()
    assert first.shape == second.shape
    assert first.dtype == np.uint8
    assert (first != second).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"disturbances": "testbed"}, "sync"),
        ({"obstacle_speed": 0.1}, "sync"),
        ({"observation": ("state", "lidar")}, "sync"),
        ({"observation": "image"}, "sync"),
        ({"render_mode": "human"}, "sync"),
        ({"action_mode": "thruster"}, "Did you mean 'thrusters'"),
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"autoreset_mode": "Never"}, "Never"),
        ({"friction": 2.0}, "friction must be in"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_bad_calls():
    env = make(2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 3)))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"must be \(2, 3\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="finite"):
        env.step(np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match="2, got 1"):
        env.reset(options={"problems": random_problems(1)})
    with pytest.raises(ValueError, match="got None"):
        env.reset(options={"problems": [None, None]})
    with pytest.raises(ValueError, match=r"\['problms'\]"):
        env.reset(options={"problms": random_problems(2)})
    with pytest.raises(ValueError, match="reset_mask must be"):
        env.reset(options={"reset_mask": np.zeros(2, dtype=bool)})
    with pytest.raises(ValueError, match="Seeds must be 2"):
        env.reset(seed=[1, 2, 3])
    np.testing.assert_array_equal(env.step(np.zeros((2, 3)))[1], 0.0)
