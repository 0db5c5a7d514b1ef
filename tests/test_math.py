"""Quaternion helpers against MuJoCo's own, angles by hand, and writes that touch only the rows they should."""

import mujoco
import numpy as np
import pytest
import torch

from legged.math import (
    evenly_spaced,
    masked_set_,
    quat_conjugate,
    quat_from_rotation_vector,
    quat_multiply,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_matrix,
    rotation_vector,
    uniform,
    wrap_to_pi,
    yaw_of,
)

QUARTER_TURN_ABOUT_Z = torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]])


def random_quats_and_vectors(count: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    quat = torch.randn(count, 4, generator=generator)
    return quat / quat.norm(dim=1, keepdim=True), 5.0 * torch.randn(count, 3, generator=generator)


def test_a_quarter_turn_about_z_takes_x_to_y():
    x, y = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]])
    torch.testing.assert_close(quat_rotate(QUARTER_TURN_ABOUT_Z, x), y)
    torch.testing.assert_close(quat_rotate_inverse(QUARTER_TURN_ABOUT_Z, y), x)


def test_rotation_is_mujocos():
    """The same convention, (w, x, y, z) and body -> world, as the engine's quaternions."""
    quats, vectors = random_quats_and_vectors()
    expected = np.zeros((len(quats), 3))
    for result, quat, vec in zip(expected, quats.double().numpy(), vectors.double().numpy(), strict=True):
        mujoco.mju_rotVecQuat(result, vec, quat)
    np.testing.assert_allclose(quat_rotate(quats, vectors), expected, atol=1e-5)


def test_products_are_mujocos():
    a, _ = random_quats_and_vectors()
    b = a.roll(1, dims=0)
    expected = np.zeros((len(a), 4))
    for result, one, other in zip(expected, a.double().numpy(), b.double().numpy(), strict=True):
        mujoco.mju_mulQuat(result, one, other)
    np.testing.assert_allclose(quat_multiply(a, b), expected, atol=1e-6)
    np.testing.assert_allclose(quat_multiply(a, quat_conjugate(a)), [[1.0, 0.0, 0.0, 0.0]] * len(a), atol=1e-6)


def test_rotation_vectors_are_mujocos():
    """Both ways, from no turn to half a turn; q and -q are one rotation."""
    quats, _ = random_quats_and_vectors()
    quats[0], quats[1] = torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0, 0.0])
    expected = np.zeros((len(quats), 3))
    for result, quat in zip(expected, quats.double().numpy(), strict=True):
        mujoco.mju_quat2Vel(result, quat if quat[0] >= 0 else -quat, 1.0)
    found = rotation_vector(quats)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    back = quat_from_rotation_vector(found)
    np.testing.assert_allclose((back * quats).sum(dim=1).abs(), 1.0, atol=1e-6)


def test_inverse_rotation_is_mujocos_with_the_conjugate():
    quats, vectors = random_quats_and_vectors()
    expected = np.zeros((len(quats), 3))
    for result, quat, vec in zip(expected, quats.double().numpy(), vectors.double().numpy(), strict=True):
        mujoco.mju_rotVecQuat(result, vec, quat * [1, -1, -1, -1])
    np.testing.assert_allclose(quat_rotate_inverse(quats, vectors), expected, atol=1e-5)


def test_yaw_is_the_heading_of_the_x_axis_whatever_the_tilt():
    """Also beyond 90 degrees of roll and pitch, where formulas from Euler angles jump."""
    quats, _ = random_quats_and_vectors()
    heading = quat_rotate(quats, torch.tensor([[1.0, 0.0, 0.0]]).expand(len(quats), 3))
    torch.testing.assert_close(yaw_of(quats), torch.atan2(heading[:, 1], heading[:, 0]), atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 1.0, 3.0])
def test_yaw_of_a_turn_about_z_is_its_angle(angle):
    half = torch.tensor(angle / 2.0)
    quat = torch.stack([half.cos(), torch.tensor(0.0), torch.tensor(0.0), half.sin()]).unsqueeze(0)
    assert yaw_of(quat).item() == pytest.approx(angle, abs=1e-6)
    assert yaw_of(-quat).item() == pytest.approx(angle, abs=1e-6)  # the other sign is the same turn


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (3.0, 3.0),
        (-3.0, -3.0),
        (4.0, 4.0 - 2 * np.pi),
        (-4.0, 2 * np.pi - 4.0),
        (np.pi, -np.pi),
        (7 * np.pi, -np.pi),
    ],
)
def test_wrap_to_pi_by_hand(angle, wrapped):
    assert wrap_to_pi(torch.tensor(angle, dtype=torch.float64)).item() == pytest.approx(wrapped, abs=1e-12)


def test_wrap_to_pi_keeps_the_direction_and_the_range():
    angle = torch.linspace(-20.0, 20.0, 1001)
    wrapped = wrap_to_pi(angle)
    assert (wrapped >= -torch.pi - 1e-6).all()
    assert (wrapped <= torch.pi + 1e-6).all()
    torch.testing.assert_close(wrapped.cos(), angle.cos(), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(wrapped.sin(), angle.sin(), atol=1e-5, rtol=0.0)


def test_uniform_fills_its_range_and_does_not_leave_it():
    torch.manual_seed(0)
    numbers = uniform(-2.0, 6.0, (1000, 2), torch.device("cpu"))
    assert numbers.shape == (1000, 2)
    assert -2.0 <= numbers.min() < -1.9
    assert 5.9 < numbers.max() <= 6.0
    assert numbers.mean().item() == pytest.approx(2.0, abs=0.2)


NAN_WITH_PAYLOAD = 0x7FC12345


@pytest.mark.parametrize("value", ["tensor", "number"])
def test_masked_set_writes_the_rows_of_the_mask_and_keeps_the_bits_of_the_others(value):
    target = torch.arange(12.0).view(4, 3)
    target.view(torch.int32)[1, 1] = NAN_WITH_PAYLOAD  # in a row that stays
    target[2, 0] = torch.nan  # in a row that is written
    before = target.clone().view(torch.int32)
    mask = torch.tensor([True, False, True, False])
    new = torch.full((4, 3), torch.nan)  # what is not asked for must not leak
    new[mask] = 7.0
    masked_set_(target, mask, new if value == "tensor" else 7.0)
    assert (target[mask] == 7.0).all()
    assert torch.equal(target.view(torch.int32)[~mask], before[~mask])


def test_masked_set_writes_through_a_view_in_place():
    """As `push` uses it: two columns of the engine's velocities."""
    whole = torch.zeros(3, 6)
    view, address = whole[:, :2], whole.data_ptr()
    masked_set_(view, torch.tensor([False, True, False]), torch.ones(3, 2))
    assert whole.data_ptr() == address
    assert whole.tolist() == [[0.0] * 6, [1.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0] * 6]


def test_masked_set_takes_tensors_of_any_rank():
    flags, blocks = torch.zeros(3, dtype=torch.bool), torch.zeros(3, 2, 2)
    mask = torch.tensor([True, False, True])
    masked_set_(flags, mask, True)
    masked_set_(blocks, mask, torch.ones(3, 2, 2))
    assert flags.tolist() == [True, False, True]
    assert blocks.sum(dim=(1, 2)).tolist() == [4.0, 0.0, 4.0]


def test_matrices_rotate_as_quaternions_do():
    generator = torch.Generator().manual_seed(4)
    quats = torch.nn.functional.normalize(torch.randn(20, 4, generator=generator), dim=1)
    vectors = torch.randn(20, 3, generator=generator)
    turned = (quat_to_matrix(quats) @ vectors.unsqueeze(2)).squeeze(2)
    torch.testing.assert_close(turned, quat_rotate(quats, vectors), atol=1e-6, rtol=0.0)
    around_z = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(quat_to_matrix(QUARTER_TURN_ABOUT_Z)[0], around_z, atol=1e-6, rtol=0.0)


@pytest.mark.parametrize(
    ("indices", "found"),
    [((3, 6, 9, 12), slice(3, 13, 3)), ((0,), slice(0, 1, 1)), ((4, 5), slice(4, 6, 1)), ((1, 2, 4), None), ((), None)],
)
def test_evenly_spaced_indices_are_a_slice(indices, found):
    assert evenly_spaced(indices) == found
    assert found is None or tuple(range(20)[found]) == indices
