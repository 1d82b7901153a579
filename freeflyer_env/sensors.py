"""What the robot may sense besides its state: a camera above the table, and a lidar on the hull."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from freeflyer_env.robot import FloatArray

_FLOOR, _SURROUND = (236, 236, 232), (90, 90, 90)
_OBSTACLE, _GOAL, _ROBOT, _NOSE = (170, 60, 50), (60, 160, 80), (40, 80, 170), (250, 210, 60)
_GOAL_WIDTH = 0.03  # m, of the ring that marks the goal
_NOSE_PLACE, _NOSE_RADIUS = 0.6, 0.35  # of the hull's radius


def top_view(
    poses: ArrayLike,
    goal: ArrayLike | None,
    obstacles: ArrayLike,
    size: tuple[int, int],
    table: tuple[float, float] = (3.5, 2.5),
    robot_radius: float = 0.15,
) -> NDArray[np.uint8]:
    """The table seen from above, with soft edges, so that places show to a fraction of a pixel.

    The robot is a blue disc, its goal a green ring, each with a yellow or green nose towards its
    heading; obstacles are red discs, as large as they are.

    Args:
        poses: ``(..., 3)`` pose ``(x, y, psi)`` of the robot in m, m, rad, table frame.
        goal: ``(..., 3)`` pose of the goal; None leaves it out.
        obstacles: ``(..., M, 3)`` rows ``(x, y, radius)`` in m; further columns are ignored, rows
            of radius zero are padding.
        size: ``(H, W)`` in pixels. The first row is the far edge of the table (largest y). The
            table fills the picture as far as the ratio of its sides allows.
        table: Size of the table in m.
        robot_radius: In m.

    Returns:
        ``(..., H, W, 3)`` uint8.
    """
    poses = np.asarray(poses, dtype=np.float32)
    rows = np.asarray(obstacles, dtype=np.float32)
    height, width = size
    pixel = max(table[0] / width, table[1] / height)
    x = np.float32(0.5 * table[0] + pixel * (np.arange(width) + 0.5 - 0.5 * width))
    y = np.float32(0.5 * table[1] - pixel * (np.arange(height) + 0.5 - 0.5 * height))
    inside = np.logical_and.outer(np.abs(2 * y - table[1]) <= table[1], (x >= 0) & (x <= table[0]))
    floor = np.where(
        inside[..., None], np.array(_FLOOR, np.float32), np.array(_SURROUND, np.float32)
    )
    picture = np.broadcast_to(floor, (*poses.shape[:-1], height, width, 3)).copy()

    def distance(centre: NDArray[np.float32]) -> NDArray[np.float32]:
        dx, dy = x - centre[..., 0, None], y - centre[..., 1, None]
        return np.sqrt(dx[..., None, :] ** 2 + dy[..., :, None] ** 2)

    def paint(inwards: NDArray[np.float32], color: tuple[int, int, int]) -> None:
        where = inwards > -0.5 * pixel
        cover = np.minimum(inwards[where] / np.float32(pixel) + np.float32(0.5), 1)[:, None]
        picture[where] += cover * (np.array(color, np.float32) - picture[where])

    def nose(pose: NDArray[np.float32]) -> NDArray[np.float32]:
        heading = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], axis=-1)
        centre = (pose[..., :2] + _NOSE_PLACE * robot_radius * heading).astype(np.float32)
        return _NOSE_RADIUS * robot_radius - distance(centre)

    depth = np.full((*rows.shape[:-2], height, width), -np.inf, dtype=np.float32)
    for index in range(rows.shape[-2]):
        row = rows[..., index, :]
        if (row[..., 2] > 0.0).any():
            radius = np.where(row[..., 2] > 0.0, row[..., 2], -np.inf)[..., None, None]
            np.maximum(depth, radius - distance(row[..., :2]), out=depth)
    paint(depth, _OBSTACLE)
    if goal is not None:
        aim = np.asarray(goal, dtype=np.float32)
        paint(0.5 * _GOAL_WIDTH - np.abs(robot_radius - distance(aim[..., :2])), _GOAL)
        paint(nose(aim), _GOAL)
    paint(robot_radius - distance(poses[..., :2]), _ROBOT)
    paint(nose(poses), _NOSE)
    return np.rint(picture).astype(np.uint8)


def lidar_angles(n_rays: int) -> FloatArray:
    """Directions ``(n_rays,)`` of the rays in rad from the robot's heading, all the way round."""
    return 2.0 * np.pi * np.arange(n_rays) / n_rays
