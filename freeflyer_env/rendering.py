"""Drawing only: table, obstacles, robot, planned and flown path, with pygame off-screen.

Everything is drawn at three times the size and scaled down, which smooths the edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from freeflyer_env.robot import FloatArray, Robot
from freeflyer_env.scenario import Scenario

_OVERSAMPLING = 3
_MARGIN = 0.09  # m of frame around the table

_FRAME = (235, 236, 240)
_TABLE = (250, 250, 252)
_GRID = (236, 238, 243)
_INK = (38, 42, 54)
_OBSTACLE = (98, 104, 120)
_KEEP_OUT = (222, 92, 84)
_GOAL = (46, 158, 98)
_PLAN = (54, 120, 224)
_BODY = (250, 200, 84)
_HULL = (255, 244, 214)
_PLUME = (255, 132, 32)


class _Canvas:
    """A surface with metres for coordinates and the y axis upwards."""

    def __init__(self, table: tuple[float, float], width: int, surface: Any = None) -> None:
        self.pygame = _pygame()
        self.scale = _OVERSAMPLING * width / (table[0] + 2 * _MARGIN)
        self.height = table[1] + 2 * _MARGIN
        size = (_OVERSAMPLING * width, round(self.height * self.scale))
        self.surface = surface or self.pygame.Surface(size)

    def pixel(self, point: ArrayLike) -> tuple[float, float]:
        x, y = np.asarray(point, dtype=np.float64)
        return (x + _MARGIN) * self.scale, (self.height - _MARGIN - y) * self.scale

    def width_of(self, metres: float) -> int:
        return max(1, round(metres * self.scale))

    def disc(self, centre: ArrayLike, radius: float, colour: Any, line: float = 0.0) -> None:
        width = self.width_of(line) if line else 0
        self.pygame.draw.circle(
            self.surface, colour, self.pixel(centre), radius * self.scale, width
        )

    def polygon(self, points: FloatArray, colour: Any) -> None:
        self.pygame.draw.polygon(self.surface, colour, [self.pixel(p) for p in points])

    def path(self, points: ArrayLike, colour: Any, line: float, dash: float = 0.0) -> None:
        """A polyline with round joints; dashes of ``dash`` metres if positive."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if len(points) < 2:
            return
        pieces = _dashes(points, dash) if dash else [points]
        for piece in pieces:
            pixels = [self.pixel(p) for p in piece]
            width = self.width_of(line)
            self.pygame.draw.lines(self.surface, colour, False, pixels, width)
            for pixel in pixels:
                self.pygame.draw.circle(self.surface, colour, pixel, width / 2)

    def ring(self, centre: ArrayLike, radius: float, colour: Any, line: float) -> None:
        """A dashed circle."""
        angles = np.linspace(0.0, 2 * np.pi, 121)
        circle = np.asarray(centre) + radius * np.column_stack([np.cos(angles), np.sin(angles)])
        self.path(circle, colour, line, dash=0.04)

    def text(self, words: str, point: ArrayLike, size: float, colour: Any) -> None:
        self.surface.blit(_font(self.width_of(size)).render(words, True, colour), self.pixel(point))


def draw_scene(
    scenario: Scenario,
    pose: ArrayLike,
    *,
    goal: ArrayLike | None = None,
    duties: ArrayLike | None = None,
    planned: ArrayLike | None = None,
    flown: ArrayLike | None = None,
    time: float | None = None,
    width: int = 600,
) -> NDArray[np.uint8]:
    """Draws one moment.

    Args:
        scenario: Table, obstacles and robot.
        pose: ``(3,)`` position in m and heading in rad of the robot.
        goal: ``(3,)`` pose of the goal, drawn as an outline.
        duties: ``(8,)`` in [0, 1], drawn as the plumes of the thrusters.
        planned: ``(P, 2)`` positions, drawn dashed.
        flown: ``(P, 2)`` positions, drawn solid.
        time: In s, written in a corner.
        width: Of the picture in pixels; the height follows from the table.

    Returns:
        ``(H, W, 3)`` picture.

    Raises:
        gymnasium.error.DependencyNotInstalled: Without pygame.
    """
    obstacles = tuple(map(tuple, scenario.obstacles.rows()))
    background = _background(scenario.table, obstacles, tuple(scenario.keep_out_radii), int(width))
    canvas = _Canvas(scenario.table, width, background.copy())
    if goal is not None:
        _draw_goal(canvas, scenario.robot, np.asarray(goal, dtype=np.float64))
    if planned is not None:
        canvas.path(planned, _PLAN, 0.014, dash=0.05)
    if flown is not None:
        canvas.path(flown, _INK, 0.012)
    _draw_robot(canvas, scenario.robot, np.asarray(pose, dtype=np.float64), duties)
    if time is not None:
        canvas.text(f"{time:.1f} s", (0.05, scenario.table[1] - 0.04), 0.13, _INK)
    return _finish(canvas, width)


def save_gif(frames: Sequence[NDArray[np.uint8]], path: str | Path, fps: float = 10.0) -> None:
    """Writes frames ``(H, W, 3)`` as an endless GIF with one palette for all of them."""
    from PIL import Image

    if not frames:
        raise ValueError("save_gif needs at least one frame.")
    sheet = Image.fromarray(np.concatenate([frames[0], frames[len(frames) // 2], frames[-1]]))
    palette = sheet.quantize(64, dither=Image.Dither.NONE)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0
    )


@lru_cache(maxsize=8)
def _background(
    table: tuple[float, float],
    obstacles: tuple[tuple[float, float, float], ...],
    keep_out_radii: tuple[float, ...],
    width: int,
) -> Any:
    canvas = _Canvas(table, width)
    canvas.surface.fill(_FRAME)
    corners = np.array([(0, 0), (table[0], 0), table, (0, table[1])], dtype=np.float64)
    canvas.polygon(corners, _TABLE)
    for x in np.arange(0.5, table[0], 0.5):
        canvas.path([(x, 0), (x, table[1])], _GRID, 0.006)
    for y in np.arange(0.5, table[1], 0.5):
        canvas.path([(0, y), (table[0], y)], _GRID, 0.006)
    canvas.path([*corners, corners[0]], _OBSTACLE, 0.012)
    for (x, y, radius), keep_out in zip(obstacles, keep_out_radii):
        canvas.disc((x, y), radius, _OBSTACLE)
        canvas.ring((x, y), keep_out, _KEEP_OUT, 0.008)
    bar = np.array([(table[0] - 0.6, 0.08), (table[0] - 0.1, 0.08)])
    canvas.path(bar, _INK, 0.012)
    canvas.text("0.5 m", (table[0] - 0.45, 0.21), 0.1, _INK)
    return canvas.surface


def _draw_robot(canvas: _Canvas, robot: Robot, pose: FloatArray, duties: ArrayLike | None) -> None:
    turn = _rotation(pose[2])
    if duties is not None:
        for duty, place, push in zip(
            np.asarray(duties), robot.thruster_positions, robot.thruster_directions
        ):
            if duty > 0.02:
                _draw_plume(canvas, pose, turn, place, push, float(duty))
    canvas.disc(pose[:2], robot.radius, _HULL)
    canvas.disc(pose[:2], robot.radius, _INK, 0.01)
    half = 0.66 * robot.radius
    square = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], dtype=np.float64)
    canvas.polygon(pose[:2] + square @ turn.T, _BODY)
    for place, push in zip(robot.thruster_positions, robot.thruster_directions):
        canvas.disc(pose[:2] + turn @ (place + 0.012 * push), 0.014, _INK)
    nose = robot.radius * np.array([(0.9, 0.0), (0.45, 0.22), (0.45, -0.22)])
    canvas.polygon(pose[:2] + nose @ turn.T, _INK)


def _draw_plume(
    canvas: _Canvas,
    pose: FloatArray,
    turn: FloatArray,
    place: FloatArray,
    push: FloatArray,
    duty: float,
) -> None:
    side = np.array([-push[1], push[0]])
    for length, half, colour in ((0.2, 0.032, _PLUME), (0.12, 0.018, (255, 222, 120))):
        tip = place - push * length * (0.25 + 0.75 * duty)
        corners = np.array([place + side * half, tip, place - side * half])
        canvas.polygon(pose[:2] + corners @ turn.T, colour)


def _draw_goal(canvas: _Canvas, robot: Robot, goal: FloatArray) -> None:
    canvas.ring(goal[:2], robot.radius, _GOAL, 0.014)
    nose = goal[:2] + _rotation(goal[2]) @ np.array([robot.radius, 0.0])
    canvas.path([goal[:2], nose], _GOAL, 0.014)
    canvas.disc(goal[:2], 0.018, _GOAL)


def _dashes(points: FloatArray, dash: float) -> list[FloatArray]:
    """Cuts a polyline into dashes of length ``dash`` with gaps of two thirds of that."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(lengths)])
    pieces = []
    for first in np.arange(0.0, arc[-1], dash * 5.0 / 3.0):
        s = np.linspace(first, min(first + dash, arc[-1]), 4)
        pieces.append(np.column_stack([np.interp(s, arc, points[:, k]) for k in range(2)]))
    return pieces


def _rotation(angle: float) -> FloatArray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def _finish(canvas: _Canvas, width: int) -> NDArray[np.uint8]:
    height = round(canvas.surface.get_height() / _OVERSAMPLING)
    small = canvas.pygame.transform.smoothscale(canvas.surface, (width, height))
    picture = canvas.pygame.surfarray.array3d(small)
    return np.ascontiguousarray(np.transpose(picture, (1, 0, 2)), dtype=np.uint8)


@lru_cache(maxsize=8)
def _font(size: int) -> Any:
    pygame = _pygame()
    pygame.font.init()
    return pygame.font.Font(None, size)


def _pygame() -> Any:
    try:
        import pygame
    except ImportError as error:
        raise gym.error.DependencyNotInstalled(
            'Rendering needs pygame: pip install "freeflyer-gym[render]".'
        ) from error
    return pygame
