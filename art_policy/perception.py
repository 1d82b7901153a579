"""What a model may see of the scene besides its discs: a picture from above, a lidar scan.

Both are what ``FreeFlyer-v0`` gives as observations, made here for whole batches, so that a model
can be trained on them at the scale of the datasets: nothing is stored.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from freeflyer_env.scenario import Scenario
from freeflyer_env.sensors import top_view

if TYPE_CHECKING:
    from art_policy.sequence import ProblemBatch

#: Size of the picture ``(H, W)`` in pixels of 6.25 cm; soft edges show places more exactly.
IMAGE_SIZE = (40, 56)
#: Rays of a scan.
N_RAYS = 32
_SCALE, _N_RAY_FEATURES = 0.5, 6  # m


def radii(discs: Tensor) -> Tensor:
    """Radii in m from keep-out radii ``discs[..., 2]``; zero stays zero."""
    scenario = Scenario()
    radius = discs[..., 2] / scenario.keep_out_factor - scenario.robot.radius
    return torch.where(discs[..., 2] > 0.0, radius, 0.0)


def pictures(problems: ProblemBatch, table: tuple[float, float]) -> Tensor:
    """Top views ``(B, 3, H, W)`` at time zero, in [0, 1]: robot at the start, goal, obstacles."""
    rows = torch.cat([problems.discs[..., :2], radii(problems.discs)[..., None]], dim=2)
    start, goal, discs = (
        value.detach().cpu().numpy() for value in (problems.start, problems.goal, rows)
    )
    view = top_view(start[:, :3], goal[:, :3], discs, IMAGE_SIZE, table)
    return as_pictures(view).to(problems.start.device)


def as_pictures(view: np.ndarray) -> Tensor:
    """Pictures ``(B, 3, H, W)`` in [0, 1] from camera images ``(B, H, W, 3)``, uint8.

    Raises:
        ValueError: If they do not have the size that models are trained on.
    """
    if view.shape[-3:] != (*IMAGE_SIZE, 3):
        raise ValueError(
            f"Camera images must have shape (..., {IMAGE_SIZE[0]}, {IMAGE_SIZE[1]}, 3), got "
            f"{view.shape}: make the environment with image_size={IMAGE_SIZE}."
        )
    return torch.from_numpy(np.moveaxis(view, -1, -3).astype(np.float32) / 255.0)


def scans(poses: Tensor, discs: Tensor, table: tuple[float, float]) -> Tensor:
    """Distances in m from the robot's centre to what a ray meets.

    Args:
        poses: ``(B, L, 3)`` poses in m, m, rad.
        discs: ``(B, L, M, 3)`` rows ``(x, y, keep-out radius)``; radius zero is padding.
        table: Its size in m; walls stop the rays.

    Returns:
        ``(B, L, N_RAYS)``, anticlockwise from ahead.
    """
    ray = _rays(poses)  # (B, L, R, 2)
    low, high = poses[..., None, :2], poses.new_tensor(table) - poses[..., None, :2]
    to_wall = torch.where(ray > 0.0, high / ray, -low / ray)  # along each axis
    reach = to_wall.where(ray.abs() > 1e-6, math.inf).amin(3).clamp(min=0.0)
    offset = discs[..., None, :, :2] - poses[..., None, None, :2]  # (B, L, 1, M, 2)
    along = (offset * ray[..., None, :]).sum(4)  # (B, L, R, M)
    radius = radii(discs)[..., None, :]
    chord = radius.square() - (offset.square().sum(4) - along.square())
    hit = (chord >= 0.0) & (along > 0.0) & (radius > 0.0)
    to_disc = torch.where(hit, along - chord.clamp(min=0.0).sqrt(), math.inf)
    if discs.shape[2]:
        reach = torch.minimum(reach, to_disc.amin(3).clamp(min=0.0))
    return reach


def _rays(poses: Tensor) -> Tensor:
    """Directions ``(B, L, N_RAYS, 2)`` in the table's frame."""
    angle = torch.arange(N_RAYS, device=poses.device) * (2.0 * math.pi / N_RAYS)
    angle = poses[..., 2:3] + angle
    return torch.stack([angle.cos(), angle.sin()], dim=3)


class PictureEncoder(nn.Module):
    """A picture to tokens: four convolutions, nothing pretrained."""

    def __init__(self, width: int) -> None:
        super().__init__()
        channels = (3, 32, 64, 128, width)
        layers: list[nn.Module] = []
        for index, (n_in, n_out) in enumerate(pairwise(channels)):
            size = 5 if index == 0 else 3
            layers += [nn.Conv2d(n_in, n_out, size, stride=2, padding=size // 2), nn.GELU()]
        self.layers = nn.Sequential(*layers[:-1])
        rows, columns = (-(-side // 16) for side in IMAGE_SIZE)
        self.n_tokens = rows * columns
        self.place_embedding = nn.Parameter(0.02 * torch.randn(self.n_tokens, width))

    def forward(self, view: Tensor) -> Tensor:
        """Tokens ``(B, n_tokens, width)`` of pictures ``(B, 3, H, W)``."""
        tokens = self.layers(2.0 * view - 1.0).flatten(2).transpose(1, 2)
        return tokens.float() + self.place_embedding


class ScanEncoder(nn.Module):
    """A scan to one token: the points that the rays meet, in no order."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.point_encoder = nn.Sequential(
            nn.Linear(_N_RAY_FEATURES, width), nn.GELU(), nn.Linear(width, width)
        )

    def forward(self, poses: Tensor, distances: Tensor) -> Tensor:
        """Tokens ``(B, L, width)`` of scans ``(B, L, N_RAYS)`` at poses ``(B, L, 3)``."""
        ray = _rays(poses)
        away = distances[..., None] * ray
        place = poses[..., None, :2] + away
        closeness = _SCALE / (distances + 0.1)
        features = torch.cat(
            [away / _SCALE, place / _SCALE, distances[..., None], closeness[..., None]], dim=3
        )
        with torch.autocast(poses.device.type, enabled=False):
            return self.point_encoder(features.float()).mean(2)
