"""Roll, pitch and yaw of rotations, against SciPy's and values worked out by hand."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.rotations import FORWARD_RPY, matrix_to_rpy

HALF_PI = math.pi / 2


def rpy_to_matrix(rpy: Tensor) -> Tensor:
    """Rz(yaw) Ry(pitch) Rx(roll). Shape (..., 3) to (..., 3, 3), float64."""
    turns = Rotation.from_euler("xyz", rpy.double().reshape(-1, 3).numpy())
    return torch.from_numpy(turns.as_matrix()).reshape(*rpy.shape, 3)


def random_rpy(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1) * math.pi


def test_angles_come_back_on_the_branch_of_the_reference() -> None:
    rpy = random_rpy(2000, seed=1)
    noise = 0.1 * (
        torch.rand(rpy.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.5
    )
    back = matrix_to_rpy(rpy_to_matrix(rpy), rpy + noise)
    # Double precision loses 1 / cos(pitch) digits towards the singularity; the draw has cos(pitch) > 1e-4.
    assert torch.cos(rpy[:, 1]).abs().min() > 1e-4
    assert_close(back, rpy, rtol=0, atol=1e-10)


def test_a_pitch_beyond_half_pi_is_kept_where_the_reference_has_one() -> None:
    rpy = torch.tensor([0.1, 0.7 * math.pi, 0.2], dtype=torch.float64)
    matrix = rpy_to_matrix(rpy)
    near = matrix_to_rpy(matrix, torch.tensor([0.0, HALF_PI, 0.0], dtype=torch.float64))
    assert_close(near, rpy)
    other = matrix_to_rpy(matrix, torch.tensor([math.pi, 0.3 * math.pi, math.pi], dtype=torch.float64))
    assert_close(other, torch.tensor([0.1 + math.pi, 0.3 * math.pi, 0.2 + math.pi], dtype=torch.float64))


def test_full_turns_follow_the_reference() -> None:
    rpy = torch.tensor([0.3, 0.4, -3.0], dtype=torch.float64)
    turned = rpy + torch.tensor([4 * math.pi, 0.0, 2 * math.pi], dtype=torch.float64)
    assert_close(matrix_to_rpy(rpy_to_matrix(rpy), turned), turned)


def test_of_all_angles_that_give_the_matrix_the_nearest_to_the_reference_are_taken() -> None:
    rpy = random_rpy(200, seed=6)
    references = 3.0 * random_rpy(200, seed=7)
    back = matrix_to_rpy(rpy_to_matrix(rpy), references)
    turns = 2 * math.pi * np.array(list(itertools.product(range(-3, 4), repeat=3)))
    gaps = []
    for (roll, pitch, yaw), reference, found in zip(
        rpy.numpy(), references.numpy(), back.numpy(), strict=True
    ):
        triples = np.array([[roll, pitch, yaw], [roll + math.pi, math.pi - pitch, yaw + math.pi]])
        candidates = (triples[:, None] + turns).reshape(-1, 3)
        distances = np.linalg.norm(candidates - reference, axis=1)
        np.testing.assert_allclose(found, candidates[distances.argmin()], rtol=0.0, atol=1e-9)
        gaps.append(np.diff(np.sort(distances)[:2]))
    assert min(gaps) > 1e-4, "two of them are equally near, so that rounding decides"


def test_the_camera_looks_forward_with_its_picture_upright_at_the_nominal_angles() -> None:
    flange = rpy_to_matrix(torch.tensor(FORWARD_RPY)).numpy()
    camera = flange @ T_flange_camera_color_optical[:3, :3]
    np.testing.assert_allclose(camera[:, 2], [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(camera[:, 1], [0.0, 0.0, -1.0], atol=1e-6)


def test_matrices_and_references_are_broadcast_against_each_other() -> None:
    rpy = 0.4 * random_rpy(6, seed=8)
    matrices, references = (
        rpy_to_matrix(rpy).reshape(2, 1, 3, 3, 3),
        2.0 * random_rpy(5, seed=9).reshape(5, 1, 3),
    )
    back = matrix_to_rpy(matrices, references)
    assert back.shape == (2, 5, 3, 3)
    for i, j, k in itertools.product(range(2), range(5), range(3)):
        assert_close(back[i, j, k], matrix_to_rpy(matrices[i, 0, k], references[j, 0]))
    assert matrix_to_rpy(matrices[0, 0, 0], references).shape == (5, 1, 3)


@pytest.mark.parametrize("pole", [HALF_PI, -HALF_PI])
def test_at_the_singularity_the_roll_of_the_reference_is_kept(pole: float) -> None:
    rpy = torch.tensor([0.25, pole, -0.4], dtype=torch.float64)
    matrix = rpy_to_matrix(rpy)
    assert_close(matrix_to_rpy(matrix, rpy), rpy, rtol=0, atol=1e-12)
    other = matrix_to_rpy(matrix, torch.tensor([1.0, pole, 0.0], dtype=torch.float64))
    assert other[0] == 1.0
    assert_close(rpy_to_matrix(other), matrix, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("dtype", "threshold"), [(torch.float64, 1e-6), (torch.float32, 1e-3)])
def test_the_matrix_of_the_angles_keeps_the_documented_bound_near_the_singularity(
    dtype: torch.dtype, threshold: float
) -> None:
    generator = torch.Generator().manual_seed(3)
    count = 4000
    rpy = random_rpy(count, seed=4)
    off = threshold * (4 * torch.rand(count, generator=generator, dtype=torch.float64) - 2)
    rpy[:, 1] = torch.where(torch.arange(count) % 2 == 0, HALF_PI, -HALF_PI) + off
    matrix = rpy_to_matrix(rpy).to(dtype)
    reference = random_rpy(count, seed=5).to(dtype)
    reference[:, 1] = rpy[:, 1].to(dtype)
    back = matrix_to_rpy(matrix, reference)
    turns = rpy_to_matrix(back).transpose(-1, -2) @ rpy_to_matrix(rpy)
    error = torch.from_numpy(Rotation.from_matrix(turns.numpy()).magnitude())
    near = off.abs() < 0.9 * threshold
    kept = back[:, 0] == reference[:, 0]
    assert kept[near].all() and not kept[off.abs() > 1.1 * threshold].any()
    # Beyond the bound itself there is only the rounding of the matrix elements.
    rounding = 4 * torch.finfo(dtype).eps
    assert error.max() <= 2 * math.asin(threshold) + rounding
    exact = 2 * torch.asin(torch.cos(rpy[:, 1]).abs()) + rounding
    assert (error[near] <= exact[near]).all()
    # The bound is not idle: with the opposite roll it is nearly reached.
    assert error[near].max() > 1.5 * threshold


def test_a_path_through_the_singularity_has_no_jumps() -> None:
    steps = torch.linspace(-1.0, 1.0, 401, dtype=torch.float64)
    path = torch.stack([0.3 + 0.1 * steps, HALF_PI + 0.2 * steps, 0.5 * steps], dim=-1)
    current = path[0]
    for wanted in path[1:]:
        found = matrix_to_rpy(rpy_to_matrix(wanted), current)
        assert (found - current).abs().max() < 0.01
        current = found
    assert_close(current, path[-1], rtol=0, atol=1e-9)


def test_leading_dimensions_and_type_are_kept() -> None:
    rpy = torch.zeros(2, 3, 3, dtype=torch.float32)
    back = matrix_to_rpy(rpy_to_matrix(rpy).float(), torch.zeros(3))
    assert back.shape == (2, 3, 3) and back.dtype == torch.float32


def test_wrong_shapes_and_integers_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="matrix"):
        matrix_to_rpy(torch.zeros(3), torch.zeros(3))
    with pytest.raises(InvalidInputError, match="floating-point"):
        matrix_to_rpy(torch.zeros(3, 3, dtype=torch.int64), torch.zeros(3))
    with pytest.raises(InvalidInputError, match=r"reference_rpy.*\(\.\.\., 3\)"):
        matrix_to_rpy(torch.eye(3), torch.zeros(4))
