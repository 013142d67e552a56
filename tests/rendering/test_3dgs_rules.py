# SPDX-License-Identifier: Apache-2.0
"""What ggslam shares with 3D Gaussian Splatting and what it draws by request: colours that end at black, its low-pass
filter, its limit of alpha and its end of a pixel."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from rendering_scenes import (
    CAMERA,
    POSE,
    make_image_gradients,
    make_scene,
    reference_gradients,
    relative_error,
    render_and_differentiate,
)

from ggslam.errors import RenderError
from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.reference import render_reference
from ggslam.rendering.types import LOW_PASS, GaussianTensors

INSTRUCTION_SETS = available_instruction_sets()


def dark_scene(coefficients: int) -> GaussianTensors:
    """Half of the colours would be below black, in the channels one by one."""
    scene = make_scene(coefficients=coefficients)
    scene.sh[:, 0] = 3 * scene.sh[:, 0] - 1.8
    return scene


def opaque_scene(count: int = 400) -> GaussianTensors:
    """Many Gaussians of more than 0.99 opacity behind one another."""
    scene = make_scene(count, coefficients=4)
    scene.opacity_logits[:] = 3 * scene.opacity_logits + 3
    return scene


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
@pytest.mark.parametrize("coefficients", [1, 9])
def test_colours_end_at_black(instruction_set: str, coefficients: int) -> None:
    scene, gradients = dark_scene(coefficients), make_image_gradients(CAMERA, 0)
    expected, expected_gradients = reference_gradients(scene, CAMERA, POSE, gradients)
    found = render_and_differentiate(CpuRasterizer(1, instruction_set), scene)
    assert found["rendered_image"].min() >= 0
    assert relative_error(found["rendered_image"], expected.image) < 1e-5
    for name in ("means", "opacity_logits", "sh", "twist"):
        assert relative_error(found[name], expected_gradients[name]) < 1e-5, name
    shown = (expected_gradients["opacity_logits"] != 0)[:, None] & (0.5 + 0.2820948 * scene.sh[:, 0] < 0)
    constant = expected_gradients["sh"][:, 0][shown]
    assert coefficients > 1 or ((constant == 0).any() and (constant < 0).any() and not (constant > 0).any())


def test_black_gaussians_can_become_brighter_but_not_darker() -> None:
    scene = dark_scene(1)
    rasterizer = CpuRasterizer(1)
    for sign in (1.0, -1.0):
        view = rasterizer.forward(scene, CAMERA, POSE)
        gradient = rasterizer.backward(torch.full_like(view.image, sign)).sh[:, 0]
        black = 0.5 + 0.2820948 * scene.sh[:, 0] < -1e-6
        assert bool(gradient[black].any()) == (sign < 0) and gradient[~black].any()


def drawn_as_3dgs(scene: GaussianTensors) -> np.ndarray:
    """The rules of 3D Gaussian Splatting (Kerbl et al. 2023) once more, pixel by pixel: image [3, H, W]."""
    lone = GaussianTensors(scene.means, scene.quaternions, scene.log_scales, torch.full((len(scene.means),), 20.0),
                           scene.sh, scene.features)  # fmt: skip
    depth = scene.means.double().numpy() @ POSE[2, :3] + POSE[2, 3]
    T, image = np.ones((CAMERA.height, CAMERA.width)), np.zeros((3, CAMERA.height, CAMERA.width))
    open_pixels = np.ones_like(T, bool)
    for row in np.argsort(depth, kind="stable"):
        one = GaussianTensors(*(getattr(lone, name)[row : row + 1].double() for name in vars(lone)))
        view = render_reference(one, CAMERA, torch.as_tensor(POSE), low_pass=0.3)
        falloff = view.alpha.numpy()  # of an opacity of 1, but for the limit of 0.999
        colour = (view.image.numpy() / np.maximum(view.alpha.numpy(), 1e-12)).reshape(3, -1).max(1)
        alpha = np.minimum(0.99, torch.sigmoid(scene.opacity_logits[row].double()).item() * falloff)
        alpha[alpha < 1 / 255] = 0
        after = T * (1 - alpha)
        open_pixels &= ~((alpha > 0) & (after < 1e-4))
        image += np.where(open_pixels, alpha * T, 0) * colour[:, None, None]
        T = np.where(open_pixels, after, T)
    return image


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
def test_drawn_as_3dgs_draws(instruction_set: str) -> None:
    scene = opaque_scene()
    rasterizer = CpuRasterizer(1, instruction_set, low_pass=0.1)
    ours = rasterizer.forward(scene, CAMERA, POSE).image.clone()
    found = rasterizer.forward(scene, CAMERA, POSE, as_3dgs=True)
    difference = np.abs(found.image.numpy() - drawn_as_3dgs(scene))
    assert difference.max() < 3e-3 and np.quantile(difference, 0.9) < 1e-5
    assert (found.image - ours).abs().max() > 0.05
    with pytest.raises(RenderError, match="no rendering to differentiate"):
        rasterizer.backward(torch.ones_like(ours))


def test_end_of_a_pixel_is_not_ours() -> None:
    """With the same low-pass filter only the limit of alpha and the last Gaussian differ: by up to a hundredth."""
    scene = opaque_scene()
    rasterizer = CpuRasterizer(1, low_pass=0.3)
    ours = rasterizer.forward(scene, CAMERA, POSE)
    image, alpha = ours.image.clone(), ours.alpha.clone()
    theirs = rasterizer.forward(scene, CAMERA, POSE, as_3dgs=True)
    assert 1e-3 < (theirs.image - image).abs().max() < 0.05
    assert theirs.alpha.max() <= 1 - 1e-4 + 1e-6 < alpha.max()


def test_no_features_as_3dgs() -> None:
    with pytest.raises(RenderError, match="as_3dgs"):
        CpuRasterizer(1).forward(make_scene(features=3), CAMERA, POSE, as_3dgs=True)
    with pytest.raises(RenderError, match="as_3dgs"):
        CpuRasterizer(1).forward(make_scene(), CAMERA, POSE, as_3dgs=True, median_depth=True)


def test_faint_maps_look_the_same_by_both_rules() -> None:
    """Opacities as training leaves them: neither of the two limits is ever reached."""
    scene = make_scene(400)
    scene.opacity_logits.clamp_max_(0.0)
    rasterizer = CpuRasterizer(1)
    assert LOW_PASS == 0.3
    ours = rasterizer.forward(scene, CAMERA, POSE).image.clone()
    assert (rasterizer.forward(scene, CAMERA, POSE, as_3dgs=True).image - ours).abs().max() < 5e-4
