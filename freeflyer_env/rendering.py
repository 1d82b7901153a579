"""Drawing only: a scene as an array of pixels, frames as a GIF or in a window.

Everything is drawn three times as large on an off-screen pygame surface and scaled down, which
smooths all edges; but for :class:`Window` no display or video driver is needed. Colours are flat,
so that GIFs are small.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import ArrayLike, NDArray

from freeflyer_env.robot import FloatArray, Robot
from freeflyer_env.scenario import Scenario

Color = tuple[int, int, int]

_SUPERSAMPLING = 3
_MARGIN = 0.12  # m of surround on each side of the table
_CAPTION = 0.24  # m below the table

_SURROUND: Color = (226, 230, 236)
_FLOOR: Color = (250, 251, 253)
_GRID: Color = (236, 239, 244)
_EDGE: Color = (52, 63, 82)
_INK: Color = (52, 63, 82)
_KEEP_OUT: Color = (253, 240, 238)
_KEEP_OUT_RING: Color = (224, 122, 110)
_OBSTACLE: Color = (112, 124, 145)
_OBSTACLE_RIM: Color = (78, 90, 112)
_PLANNED: Color = (126, 168, 236)
_FLOWN: Color = (236, 122, 28)
_START: Color = (150, 160, 176)
_GOAL: Color = (44, 150, 96)
_HULL: Color = (214, 221, 232)
_BODY: Color = (250, 251, 253)
_PANEL: Color = (52, 88, 150)
_FLAME: Color = (255, 150, 40)
_FLAME_CORE: Color = (255, 226, 120)


def draw_scene(
    scenario: Scenario,
    pose: ArrayLike,
    *,
    start: ArrayLike | None = None,
    goal: ArrayLike | None = None,
    duties: ArrayLike | None = None,
    planned: ArrayLike | None = None,
    flown: ArrayLike | None = None,
    time: float | None = None,
    width: int = 748,
) -> NDArray[np.uint8]:
    """Draws the table seen from above, x to the right and y upwards.

    Args:
        scenario: Table, obstacles (keep-out radii dashed) and robot.
        pose: ``(3,)`` robot pose ``(r_x, r_y, psi)`` in m, m, rad.
        start: ``(3,)`` start pose, drawn as a grey ghost.
        goal: ``(3,)`` goal pose, drawn as a green ghost.
        duties: ``(8,)`` thruster duties in [0, 1]; a plume is as long as its duty is large.
        planned: ``(N, 2)`` planned path in m, dashed.
        flown: ``(K, 2)`` flown path in m, solid.
        time: Time to print in s.
        width: Of the picture in pixels; the height follows from the table.

    Returns:
        ``(H, W, 3)`` uint8; height and width are even, as video encoders want them.

    Raises:
        gymnasium.error.DependencyNotInstalled: Without pygame (``pip install
            "freeflyer-gym[render]"``).
    """
    discs = np.column_stack([scenario.obstacles.rows()[:, :3], scenario.keep_out_radii])
    table = _table_drawn(tuple(scenario.table), tuple(map(tuple, discs.tolist())), int(width))
    canvas = _Canvas(scenario.table, width, table.copy())
    for ghost, color in ((start, _START), (goal, _GOAL)):
        if ghost is not None:
            _draw_ghost(canvas, scenario.robot, np.asarray(ghost), color)
    if planned is not None:
        for dash in _dashes(canvas.pixels(planned), canvas.length(0.045), canvas.length(0.035)):
            canvas.polyline(dash, 0.02, _PLANNED)
    if flown is not None:
        canvas.polyline(_thinned(canvas.pixels(flown)), 0.011, _FLOWN)
    _draw_robot(canvas, scenario.robot, np.asarray(pose, dtype=np.float64), duties)
    _draw_caption(canvas, time, planned is not None, flown is not None)
    return canvas.array()


def save_gif(frames: Sequence[NDArray[np.uint8]], path: str | Path, fps: float = 10.0) -> None:
    """Writes frames ``(H, W, 3)`` uint8 as a GIF that plays in a loop.

    All frames share one palette; with flat colours and without dithering a frame stores little
    more than what moved.

    Raises:
        ValueError: Without frames, or if ``fps`` is not positive.
        gymnasium.error.DependencyNotInstalled: Without Pillow.
    """
    if len(frames) == 0:
        raise ValueError("save_gif needs at least one frame.")
    if not fps > 0.0:
        raise ValueError(f"fps must be positive, got {fps}.")
    try:
        from PIL import Image
    except ImportError as error:
        raise DependencyNotInstalled(
            'Pillow is not installed: pip install "freeflyer-gym[render]"'
        ) from error
    # Plumes and paths are not in every frame: the palette is made from several.
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, 6).astype(int)]
    palette = Image.fromarray(np.concatenate(chosen)).quantize(64)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    # GIF counts in hundredths of a second.
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=10 * max(round(100.0 / fps), 1),
        loop=0,
    )


class Window:
    """A window that shows frames at a steady rate.

    Args:
        title: Of the window.
        fps: Frames per second; :meth:`show` waits until the next one is due.
    """

    def __init__(self, title: str, fps: float) -> None:
        self._pygame = _import_pygame()
        self._title, self._fps = title, fps
        self._screen: Any = None
        self._clock = self._pygame.time.Clock()

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Shows a frame ``(H, W, 3)`` uint8."""
        size = (frame.shape[1], frame.shape[0])
        if self._screen is None or self._screen.get_size() != size:
            self._pygame.display.init()
            self._screen = self._pygame.display.set_mode(size)
            self._pygame.display.set_caption(self._title)
        self._pygame.surfarray.blit_array(self._screen, frame.swapaxes(0, 1))
        self._pygame.event.pump()
        self._pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Closes the window."""
        self._pygame.display.quit()
        self._screen = None


class _Canvas:
    """An off-screen surface with metric coordinates."""

    def __init__(self, table: tuple[float, float], width: int, surface: Any = None) -> None:
        if width < 100:
            raise ValueError(f"width must be at least 100 pixels, got {width}.")
        self.pygame = _import_pygame()
        pixels_per_metre = width / (table[0] + 2 * _MARGIN)
        height = (table[1] + _MARGIN + _CAPTION) * pixels_per_metre
        self.table, self.scale = table, _SUPERSAMPLING * pixels_per_metre
        self.size = (2 * (width // 2), 2 * round(height / 2))
        large = (self.size[0] * _SUPERSAMPLING, self.size[1] * _SUPERSAMPLING)
        self.surface = surface or self.pygame.Surface(large, depth=24)

    def pixels(self, points: Any) -> FloatArray:
        """Points ``(..., 2)`` in m as pixels of the large surface."""
        points = np.asarray(points, dtype=np.float64)
        origin = np.array([_MARGIN, self.table[1] + _MARGIN])
        return (origin + points * (1.0, -1.0)) * self.scale

    def length(self, metres: float) -> float:
        """A length in pixels of the large surface."""
        return metres * self.scale

    def disc(self, centre: Any, radius: float, color: Color) -> None:
        self.pygame.draw.circle(self.surface, color, self.pixels(centre), self.length(radius))

    def polygon(self, points: Any, color: Color) -> None:
        self.pygame.draw.polygon(self.surface, color, self.pixels(points))

    def ring(
        self, centre: Any, radius: float, width: float, color: Color, n_dashes: int = 0
    ) -> None:
        """A circle's outline, in dashes if a number of them is given."""
        angles = np.linspace(0.0, 2.0 * np.pi, 241)
        circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        circle = self.pixels(np.asarray(centre) + circle)
        if not n_dashes:
            self.polyline(circle, width, color)
            return
        part = self.length(2.0 * np.pi * radius) / (2 * n_dashes)
        for piece in _dashes(circle, part, part):
            self.polyline(piece, width, color)

    def polyline(self, points: FloatArray, width: float, color: Color) -> None:
        """A line of ``width`` m with round joints through pixels ``(K, 2)``."""
        half = 0.5 * self.length(width)
        for point in points:
            self.pygame.draw.circle(self.surface, color, point, half)
        for first, second in pairwise(points):
            along = second - first
            distance = float(np.hypot(*along))
            if distance > 0.0:
                side = half / distance * np.array([-along[1], along[0]])
                corners = [first + side, second + side, second - side, first - side]
                self.pygame.draw.polygon(self.surface, color, corners)

    def text(self, text: str, position: Any, color: Color, align: float = 0.0) -> float:
        """Writes a line 0.09 m high, centred in height; returns its width in m."""
        picture = _font(round(self.length(0.13))).render(text, True, color)
        x, y = self.pixels(position)
        width, height = picture.get_size()
        self.surface.blit(picture, (round(x - align * width), round(y - 0.5 * height)))
        return float(width / self.scale)

    def array(self) -> NDArray[np.uint8]:
        """The picture, scaled down: ``(H, W, 3)``."""
        small = self.pygame.transform.smoothscale(self.surface, self.size)
        return np.ascontiguousarray(self.pygame.surfarray.array3d(small).swapaxes(0, 1))


def _import_pygame() -> Any:
    # The greeting would spoil a command's machine-readable output.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError as error:
        raise DependencyNotInstalled(
            'pygame is not installed: pip install "freeflyer-gym[render]"'
        ) from error
    pygame.font.init()
    return pygame


def _font(size: int) -> Any:
    """A fresh font: a kept one dies with ``pygame.quit()``, which other environments call."""
    return _import_pygame().font.Font(None, size)


@lru_cache(maxsize=8)
def _table_drawn(
    table: tuple[float, float], discs: tuple[tuple[float, ...], ...], width_pixels: int
) -> Any:
    """Surface with what does not move; discs are rows ``(x, y, radius, keep-out radius)``."""
    canvas, (width, height), edge = _Canvas(table, width_pixels), table, 0.018
    canvas.surface.fill(_SURROUND)
    canvas.polygon(_box(0.0, 0.0, width, height), _FLOOR)
    for x, y, _, keep_out in discs:
        canvas.disc((x, y), keep_out, _KEEP_OUT)
    for x in np.arange(0.5, width, 0.5):
        canvas.polygon(_box(x - 0.002, 0.0, x + 0.002, height), _GRID)
    for y in np.arange(0.5, height, 0.5):
        canvas.polygon(_box(0.0, y - 0.002, width, y + 0.002), _GRID)
    for x, y, _, keep_out in discs:
        canvas.ring((x, y), keep_out, 0.006, _KEEP_OUT_RING, n_dashes=round(60 * keep_out))
    for x, y, radius, _ in discs:
        canvas.disc((x, y), radius, _OBSTACLE_RIM)
        canvas.disc((x, y), radius - 0.012, _OBSTACLE)
    # Keep-out discs may reach over the edge of the table.
    for strip in (
        _box(-_MARGIN, -_CAPTION, width + _MARGIN, -edge),
        _box(-_MARGIN, height + edge, width + _MARGIN, height + _MARGIN),
        _box(-_MARGIN, -edge, -edge, height + edge),
        _box(width + edge, -edge, width + _MARGIN, height + edge),
    ):
        canvas.polygon(strip, _SURROUND)
    corners = canvas.pixels(_box(-edge / 2, -edge / 2, width + edge / 2, height + edge / 2))
    canvas.polyline(np.vstack([corners, corners[:1]]), edge, _EDGE)
    return canvas.surface


def _draw_ghost(canvas: _Canvas, robot: Robot, pose: FloatArray, color: Color) -> None:
    """Outline of the robot with its heading."""
    radius = robot.radius
    canvas.ring(pose[:2], radius - 0.006, 0.012, color)
    half = 0.58 * radius
    square = canvas.pixels(_placed(_box(-half, -half, half, half), pose))
    canvas.polyline(np.vstack([square, square[:1]]), 0.007, color)
    nose = [(0.95 * radius, 0.0), (0.66 * radius, 0.2 * radius), (0.66 * radius, -0.2 * radius)]
    canvas.polygon(_placed(nose, pose), color)


def _draw_robot(canvas: _Canvas, robot: Robot, pose: FloatArray, duties: ArrayLike | None) -> None:
    """A square body with a nose in a disc hull; plumes where thrusters fire."""
    radius, unit = robot.radius, robot.radius / 0.15
    nozzles = list(zip(robot.thruster_positions, -robot.thruster_directions))
    for (position, exhaust), duty in zip(
        nozzles, np.zeros(8) if duties is None else np.asarray(duties)
    ):
        if duty > 0.0:
            across = np.array([-exhaust[1], exhaust[0]])
            for size, color in ((1.0, _FLAME), (0.55, _FLAME_CORE)):
                tip = position + unit * size * (0.07 + 0.13 * duty) * exhaust
                bulge = position + unit * size * (0.02 + 0.03 * duty) * exhaust
                side = unit * size * 0.024 * across
                flame = [position + 0.5 * side, bulge + side, tip, bulge - side]
                canvas.polygon(_placed([*flame, position - 0.5 * side], pose), color)
    canvas.disc(pose[:2], radius, _EDGE)
    canvas.disc(pose[:2], radius - 0.01 * unit, _HULL)
    for position, exhaust in nozzles:
        across = 0.013 * unit * np.array([-exhaust[1], exhaust[0]])
        base = position - 0.028 * unit * exhaust
        cone = [base - 0.5 * across, position - across, position + across, base + 0.5 * across]
        canvas.polygon(_placed(cone, pose), _EDGE)
    half = 0.62 * radius
    canvas.polygon(_placed(_box(-half, -half, half, half), pose), _EDGE)
    half -= 0.009 * unit
    canvas.polygon(_placed(_box(-half, -half, half, half), pose), _BODY)
    canvas.polygon(_placed(_box(-0.7 * half, -0.72 * half, -0.1 * half, 0.72 * half), pose), _PANEL)
    nose = half * np.array([(0.85, 0.0), (0.2, 0.5), (0.2, -0.5)])
    canvas.polygon(_placed(nose, pose), _FLOWN)


def _draw_caption(canvas: _Canvas, time: float | None, planned: bool, flown: bool) -> None:
    """Time on the left, what the lines are in the middle, a scale bar on the right."""
    width, y = canvas.table[0], -0.5 * (_CAPTION + 0.018)
    if time is not None:
        canvas.text(f"{time:5.1f} s", (0.0, y), _INK)
    x = 0.5 * width - 0.5
    for shown, name, color, dashed in (
        (planned, "planned", _PLANNED, True),
        (flown, "flown", _FLOWN, False),
    ):
        if shown:
            line = canvas.pixels([(x, y), (x + 0.2, y)])
            on = canvas.length(0.045)
            for piece in _dashes(line, on, canvas.length(0.035)) if dashed else [line]:
                canvas.polyline(piece, 0.016, color)
            x += 0.25 + canvas.text(name, (x + 0.25, y), _INK) + 0.2
    bar = canvas.pixels([(width - 0.5, y + 0.02), (width - 0.5, y - 0.02)])
    canvas.polyline(bar, 0.01, _INK)
    canvas.polyline(bar + np.array([canvas.length(0.5), 0.0]), 0.01, _INK)
    canvas.polyline(canvas.pixels([(width - 0.5, y), (width, y)]), 0.01, _INK)
    canvas.text("0.5 m", (width - 0.56, y), _INK, align=1.0)


def _box(left: float, low: float, right: float, high: float) -> FloatArray:
    return np.array([(left, low), (right, low), (right, high), (left, high)])


def _placed(points: Any, pose: FloatArray) -> FloatArray:
    """Body-frame points ``(K, 2)`` on the table."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return pose[:2] + np.asarray(points) @ np.array([[cos, sin], [-sin, cos]])


def _thinned(points: FloatArray) -> FloatArray:
    """Pixels ``(K, 2)`` without those too close to the one before to be seen apart."""
    if not len(points):
        return points
    kept = [0]
    for index, point in enumerate(points):
        if np.hypot(*(point - points[kept[-1]])) >= _SUPERSAMPLING:
            kept.append(index)
    return points[[*kept, len(points) - 1]]


def _dashes(points: FloatArray, on: float, off: float) -> Iterator[FloatArray]:
    """Cuts a line through pixels ``(K, 2)`` into dashes ``on`` long, ``off`` apart."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    for begin in np.arange(0.0, along[-1], on + off):
        end = min(begin + on, along[-1])
        inside = along[(along > begin) & (along < end)]
        cuts = np.concatenate([[begin], inside, [end]])
        yield np.column_stack([np.interp(cuts, along, axis) for axis in points.T])
