"""Pictures and GIFs."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from freeflyer_env import Obstacles, Scenario
from freeflyer_env.rendering import draw_scene, save_gif

SCENE = Scenario.named("nominal")
POSE = np.array([1.75, 1.25, 0.3])


def colours(picture):
    return {tuple(colour) for colour in picture.reshape(-1, 3).tolist()}


def test_a_picture_has_the_tables_shape_and_is_not_blank():
    picture = draw_scene(SCENE, POSE, width=401)
    height, width, channels = picture.shape
    assert (width, channels) == (400, 3)
    assert height % 2 == 0
    assert picture.dtype == np.uint8
    assert picture.flags.c_contiguous
    assert len(colours(picture)) > 20


@pytest.mark.parametrize(
    "part",
    [
        {"start": [0.3, 1.0, 0.0]},
        {"goal": [3.2, 1.0, 0.0]},
        {"duties": [1, 0, 0, 0, 0, 0, 0, 0]},
        {"planned": [[0.5, 0.5], [3.0, 2.0]]},
        {"flown": [[0.5, 0.5], [3.0, 2.0]]},
        {"time": 3.0},
    ],
    ids=lambda part: next(iter(part)),
)
def test_every_part_shows_and_leaves_nothing_behind(part):
    plain = draw_scene(SCENE, POSE, width=300)
    assert (draw_scene(SCENE, POSE, width=300, **part) != plain).any()
    np.testing.assert_array_equal(draw_scene(SCENE, POSE, width=300), plain)


def test_the_robot_is_where_it_should_be():
    scene = Scenario.named("nominal")
    away = draw_scene(scene, [0.4, 1.25, 0.0], width=748).astype(int)
    here = draw_scene(scene, [0.4, 2.2, 0.0], width=748).astype(int)
    rows, columns = np.nonzero(np.abs(here - away).sum(-1)[: away.shape[0] // 3])
    scale = 748 / 3.74
    assert columns.mean() == pytest.approx((0.12 + 0.4) * scale, abs=2)
    assert rows.mean() == pytest.approx((0.12 + 0.3) * scale, abs=2)


def test_plumes_point_against_the_push():
    plain = draw_scene(SCENE, [1.75, 1.25, 0.0], width=748).astype(int)
    duties = np.zeros(8)
    duties[[2, 5]] = 1.0  # forwards: exhaust to the left
    fired = draw_scene(SCENE, [1.75, 1.25, 0.0], duties=duties, width=748).astype(int)
    columns = np.nonzero(np.abs(fired - plain).sum(-1))[1]
    assert columns.max() < (0.12 + 1.75) * 200
    assert columns.min() < (0.12 + 1.75 - 0.25) * 200


@pytest.mark.parametrize("path", [[[1.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]]])
def test_paths_without_length(path):
    draw_scene(SCENE, POSE, planned=path, flown=path, width=200)


def test_a_flight_as_gif_is_small(tmp_path):
    x = np.linspace(0.3, 3.2, 100)
    path = np.column_stack([x, 1.25 + 0.1 * np.sin(x)])
    duties = np.random.default_rng(0).uniform(size=(100, 8)) > 0.6
    frames = [
        draw_scene(
            SCENE, [*path[i], 0.02 * i], duties=duties[i], planned=path, flown=path[: i + 1], time=i
        )
        for i in range(len(path))
    ]
    file = tmp_path / "flight.gif"
    save_gif(frames, file, fps=10)
    assert file.stat().st_size < 1_000_000
    with Image.open(file) as gif:
        assert gif.n_frames == 100
        assert gif.size == frames[0].shape[1::-1]
        assert gif.info["duration"] == 100
        # Colours survive the shared palette.
        difference = np.abs(np.asarray(gif.convert("RGB"), dtype=int) - frames[0])
        assert np.mean(difference) < 2.0


def test_bad_input(tmp_path):
    with pytest.raises(ValueError, match="at least one frame"):
        save_gif([], tmp_path / "x.gif")
    with pytest.raises(ValueError, match="fps must be positive"):
        save_gif([np.zeros((2, 2, 3), np.uint8)], tmp_path / "x.gif", fps=0.0)
    with pytest.raises(ValueError, match="width must be at least"):
        draw_scene(SCENE, POSE, width=10)


@pytest.mark.parametrize(
    ("module", "use"),
    [
        ("pygame", lambda: draw_scene(SCENE, POSE)),
        ("PIL", lambda: save_gif([np.zeros((2, 2, 3), np.uint8)], "never_written.gif")),
    ],
)
def test_a_missing_package_is_named_with_its_remedy(module, use, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(gym.error.DependencyNotInstalled, match=r"freeflyer-gym\[render\]"):
        use()


def test_an_empty_table_and_empty_paths_can_be_drawn():
    empty = Scenario(Obstacles.from_rows([]))
    picture = draw_scene(empty, (1.0, 1.0, 0.0), planned=np.zeros((0, 2)), flown=np.zeros((0, 2)))
    assert picture.dtype == np.uint8
