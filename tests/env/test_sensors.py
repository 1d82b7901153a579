"""Camera and lidar against geometry."""

import gymnasium as gym
import numpy as np
import pytest

from freeflyer_env import Obstacles, Problem, Scenario
from freeflyer_env.sensors import lidar_angles, top_view

ROW = [2.0, 1.0, 0.2]
PROBLEM = Problem(
    Scenario(Obstacles.from_rows([ROW])), [0.5, 1.0, 0, 0, 0, 0], [3.2, 1.0, 0, 0, 0, 0]
)


def observed(problem=PROBLEM, **arguments):
    env = gym.make("FreeFlyer-v0", scenario=problem.scenario, **arguments)
    observation, _ = env.reset(seed=0, options={"problem": problem})
    assert env.observation_space.contains(observation)
    return observation


def test_modalities_choose_the_keys():
    assert set(observed()) == {"state", "goal", "obstacles", "time_to_go"}
    keys = observed(observation=("robot", "image", "lidar"), image_size=(40, 56), lidar_rays=8)
    assert set(keys) == {"state", "goal", "time_to_go", "image", "lidar"}
    assert keys["image"].shape == (40, 56, 3)
    assert keys["lidar"].shape == (8,)


def test_an_observation_of_any_modality_with_the_state_is_a_problem():
    observation = observed(observation=("state", "lidar", "image"))
    again = Problem.from_dict(observation)
    np.testing.assert_allclose(again.start, PROBLEM.start, atol=1e-6)
    assert again.final_time == PROBLEM.final_time


def test_lidar_measures_discs_and_walls():
    ranges = observed(observation="lidar", lidar_rays=4)["lidar"]
    np.testing.assert_allclose(ranges, [1.5 - 0.2, 1.5, 0.5, 1.0], atol=1e-5)


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_lidar_turns_with_the_robot(heading):
    start = PROBLEM.start.copy()
    start[2] = heading
    problem = Problem(PROBLEM.scenario, start, PROBLEM.goal)
    ranges = observed(problem, observation="lidar", lidar_rays=64)["lidar"]
    angles = lidar_angles(64) + heading
    for angle, distance in zip(angles, ranges):
        ray = np.array([np.cos(angle), np.sin(angle)])
        with np.errstate(divide="ignore"):
            to_walls = np.where(ray > 0, ([3.5, 2.5] - start[:2]) / ray, -start[:2] / ray).min()
        offset = np.array(ROW[:2]) - start[:2]
        along, across = ray @ offset, ray[0] * offset[1] - ray[1] * offset[0]
        if along > 0 and abs(across) < ROW[2]:
            to_walls = along - np.sqrt(ROW[2] ** 2 - across**2)
        assert distance == pytest.approx(to_walls, abs=1e-5)


def test_lidar_is_noisy_if_asked():
    exact = observed(observation="lidar")["lidar"]
    noisy = observed(observation="lidar", disturbances={"range_noise": 0.01})["lidar"]
    assert 0.003 < np.std(noisy - exact) < 0.03


def test_lidar_sees_what_the_robot_may_pass_through():
    ranges = observed(observation="lidar", lidar_rays=4, contacts=False)["lidar"]
    assert ranges[0] == pytest.approx(1.3, abs=1e-5)


def test_the_image_shows_everything_where_it_is():
    size, scale = (100, 140), 40.0
    picture = top_view([0.5, 1.0, 0.0], [3.2, 2.0, 0.0], [ROW, [0, 0, 0]], size).astype(int)
    red = (picture[..., 0] - picture[..., 2]) > 60
    red &= picture[..., 1] < 100
    rows, columns = np.nonzero(red)
    assert np.mean(columns + 0.5) / scale == pytest.approx(ROW[0], abs=0.01)
    assert 2.5 - np.mean(rows + 0.5) / scale == pytest.approx(ROW[1], abs=0.01)
    assert red.sum() / scale**2 == pytest.approx(np.pi * ROW[2] ** 2, rel=0.1)
    blue = (picture[..., 2] - picture[..., 0]) > 60
    rows, columns = np.nonzero(blue)
    assert 2.5 - np.mean(rows + 0.5) / scale == pytest.approx(1.0, abs=0.01)
    assert columns.max() / scale < 0.66
    turned = top_view([0.5, 1.0, 1.0], [3.2, 2.0, 0.0], [ROW], size)
    assert (turned != picture).any()


def test_images_of_a_batch_are_those_of_its_members():
    rng = np.random.default_rng(0)
    poses, rows = rng.uniform(0.2, 2.3, (5, 3)), rng.uniform(0.1, 2.0, (5, 3, 3))
    together = top_view(poses, poses[::-1], rows, (48, 48))
    for index in range(5):
        alone = top_view(poses[index], poses[::-1][index], rows[index], (48, 48))
        np.testing.assert_array_equal(together[index], alone)


def test_the_table_is_centred_in_a_picture_of_another_ratio():
    picture = top_view([1.75, 1.25, 0.0], None, np.zeros((0, 3)), (64, 64))
    assert (picture[0] == picture[0, 0]).all()
    assert (picture[0, 0] != picture[20, 5]).any()
