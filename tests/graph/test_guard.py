"""The guard finds, without a GPU, what no CUDA graph can hold: host reads, host data, and Python state."""

import copy

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from legged.graph.guard import ForbidHostReads, HostReadError
from legged.graph.step_graph import StepGraph

CPU = torch.device("cpu")
NUMBERS = torch.tensor([1.0, -2.0, 3.0])
GRID = torch.arange(12.0).view(3, 4)
CUBE = torch.arange(24.0).view(2, 3, 4)
MASK = NUMBERS > 0.0
ONE, FIRST_AND_LAST, WITHIN = torch.tensor(1), torch.tensor([0, 2]), torch.tensor([0, 1])
FIVE = torch.tensor([5.0, 6.0])
ARRAY = np.array([1.0, 2.0, 3.0])


def write_by_mask() -> torch.Tensor:
    numbers = NUMBERS.clone()
    numbers[MASK] = 0.0
    return numbers


def write_by_mask_tensor() -> None:
    NUMBERS.clone()[MASK] = NUMBERS[:2]


def branch_on_a_tensor() -> None:
    if MASK.any():
        pass


REFUSED = {
    "item": lambda: NUMBERS.sum().item(),
    "float": lambda: float(NUMBERS[0]),
    "int": lambda: int(NUMBERS[0]),
    "if": branch_on_a_tensor,
    "is_nonzero": lambda: torch.is_nonzero(NUMBERS[0]),
    "write by a number": lambda: NUMBERS.clone().__setitem__(ONE, 0.0),
    "nonzero": lambda: MASK.nonzero(),
    "where with one argument": lambda: torch.where(MASK),
    "argwhere": lambda: torch.argwhere(MASK),
    "read by mask": lambda: NUMBERS[MASK],
    "write a tensor by mask": write_by_mask_tensor,
    "read by a mask of bytes": lambda: NUMBERS[MASK.to(torch.uint8)],
    "masked_select": lambda: NUMBERS.masked_select(MASK),
    "unique": lambda: NUMBERS.unique(),
    "repeat_interleave": lambda: NUMBERS.repeat_interleave(FIRST_AND_LAST[[0, 1, 1]]),
    "allclose": lambda: torch.allclose(NUMBERS, NUMBERS),
    "inverse": lambda: torch.inverse(GRID[:, :3] + torch.eye(3, device=CPU)),
    "solve": lambda: torch.linalg.solve(torch.eye(3, device=CPU), NUMBERS),
    "cholesky": lambda: torch.linalg.cholesky(torch.eye(3, device=CPU)),
    "svd": lambda: torch.linalg.svd(GRID),
    "pinv": lambda: torch.linalg.pinv(GRID),
    "eigh": lambda: torch.linalg.eigh(GRID[:, :3]),
    "eig": lambda: torch.linalg.eig(GRID[:, :3]),
    "matrix_exp": lambda: torch.linalg.matrix_exp(GRID[:, :3]),
    "to_sparse": lambda: NUMBERS.to_sparse(),
    "normal with tensors": lambda: torch.normal(NUMBERS, NUMBERS.abs()),
    "multinomial": lambda: torch.multinomial(GRID, 1),
    "max of Python": lambda: max(NUMBERS),
    "in": lambda: 3.0 in NUMBERS,
    "format": lambda: f"{NUMBERS[0]:.2f}",
    "print": lambda: repr(NUMBERS),
    "cpu": lambda: NUMBERS.cpu(),
    "to cpu": lambda: NUMBERS.to("cpu"),
    "to cpu by keyword": lambda: NUMBERS.to(device="cpu", dtype=torch.float64),
    "type of a CPU tensor": lambda: NUMBERS.type(torch.LongTensor),
    "numpy": lambda: NUMBERS.numpy(),
    "cpu and numpy": lambda: NUMBERS.cpu().numpy(),
    "tolist": lambda: NUMBERS.tolist(),
    "asarray of numpy": lambda: np.asarray(NUMBERS),
    "a function of numpy": lambda: np.sin(NUMBERS),
    "plus an array": lambda: NUMBERS + ARRAY,
    "from_dlpack": lambda: np.from_dlpack(NUMBERS),
    "tensor": lambda: torch.tensor([1.0, 2.0]),
    "as_tensor": lambda: torch.as_tensor(ARRAY),
    "from_numpy": lambda: torch.from_numpy(ARRAY),
    "FloatTensor": lambda: torch.FloatTensor([1.0]),
    "Tensor": lambda: torch.Tensor([1.0]),
    "tensor of tensors": lambda: torch.tensor([NUMBERS[0], NUMBERS[1]], device=CPU),
    "index by an array of bytes": lambda: GRID[:, np.array([1, 0, 1, 0], dtype=np.uint8)],
    "index by a list of tensors": lambda: GRID[:, [ONE, ONE]],
    "zeros": lambda: torch.zeros(3),
    "ones": lambda: torch.ones(3),
    "full": lambda: torch.full((3,), 2.0),
    "empty": lambda: torch.empty(3),
    "arange": lambda: torch.arange(3),
    "linspace": lambda: torch.linspace(0.0, 1.0, 3),
    "eye": lambda: torch.eye(3),
    "rand": lambda: torch.rand(3),
    "randn": lambda: torch.randn(3),
    "randint": lambda: torch.randint(3, (2,)),
    "randperm": lambda: torch.randperm(3),
    "normal": lambda: torch.normal(0.0, 1.0, (3,)),
    "zeros on the CPU by name": lambda: torch.zeros(3, device="cpu"),
}

ALLOWED = {
    "where": lambda: torch.where(MASK, NUMBERS, 0.0),
    "masked_fill": lambda: NUMBERS.masked_fill(MASK, 0.0),
    "write a number by mask": write_by_mask,
    "read by positions": lambda: NUMBERS[FIRST_AND_LAST],
    "read by a number": lambda: (NUMBERS[ONE], GRID[ONE, 1:], GRID[:, ONE], GRID[..., ONE], GRID[None, ..., ONE, :]),
    "read by numbers": lambda: (GRID[ONE, ONE + 1], GRID[1:, -ONE], GRID[ONE, [0, 2]], [GRID[:, i] for i in FIRST_AND_LAST]),
    "read by a number and more": lambda: (
        CUBE[ONE, :, [0, 2]],
        CUBE[[0, 1], ..., ONE],
        CUBE[:, ONE, None, 2],
        CUBE[ONE][ONE],
    ),
    "write by positions": lambda: NUMBERS.clone().index_put_((WITHIN,), FIVE),
    "slice and ellipsis": lambda: NUMBERS[None, ..., 1:],
    "draw in place": lambda: NUMBERS.clone().uniform_(),
    "reduce": lambda: (NUMBERS * MASK).sum() / MASK.sum(),
    "with a device": lambda: torch.zeros(3, device=NUMBERS.device) + torch.rand(3, device=CPU),
    "like another": lambda: torch.zeros_like(NUMBERS) + NUMBERS.new_zeros(3) + NUMBERS.new_full((3,), 2.0),
    "tensor of a tensor": lambda: torch.as_tensor(NUMBERS),
    "tensor of numbers": lambda: torch.tensor([1, 2], dtype=torch.float32, device=CPU),
    "tensor of an array": lambda: torch.as_tensor(ARRAY, device=NUMBERS.device),
    "new_tensor": lambda: NUMBERS.new_tensor([1.0, 2.0]),
    "draw into": lambda: torch.randn(3, out=NUMBERS.clone()),
    "to a type": lambda: NUMBERS.to(torch.float64).type(torch.int64).long(),
    "to the task's device": lambda: NUMBERS.to(CPU),
    "one_hot": lambda: torch.nn.functional.one_hot(FIRST_AND_LAST, 4),
    "repeat_interleave of known size": lambda: NUMBERS.repeat_interleave(2),
    "iterate": lambda: sum(column.sum() for column in GRID),
    "shape": lambda: (len(GRID), GRID.shape, GRID.dim(), GRID.is_cuda),
    "quantile": lambda: NUMBERS.quantile(0.5),
    "deepcopy": lambda: copy.deepcopy(NUMBERS),
}


@pytest.fixture(params=[False, True], ids=["plain", "inference"])
def inference(request):
    """The task steps in inference mode, where operators reach a dispatch mode in other pieces."""
    with torch.inference_mode(request.param):
        yield


@pytest.mark.filterwarnings("ignore:indexing with dtype torch.uint8", "ignore:__array_wrap__")
@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.usefixtures("inference")
def test_what_waits_for_the_host_is_refused(name):
    REFUSED[name]()  # ordinary code outside the guard
    with ForbidHostReads(), pytest.raises(HostReadError, match="CUDA graph"):
        REFUSED[name]()


@pytest.mark.parametrize("name", ALLOWED)
@pytest.mark.usefixtures("inference")
def test_what_a_graph_can_hold_passes_and_gives_the_same(name):
    torch.manual_seed(0)
    expected = ALLOWED[name]()
    torch.manual_seed(0)
    with ForbidHostReads():
        found = ALLOWED[name]()
    torch.testing.assert_close(found, expected, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("name", ALLOWED)
def test_what_a_graph_can_hold_passes_step_after_step(name):
    """Nothing of it looks like a number that changes, or like memory that a recording would keep."""
    assert not StepGraph(ALLOWED[name], CPU, enabled=True).captured


def test_the_message_says_what_to_write_instead():
    with ForbidHostReads(), pytest.raises(HostReadError, match=r"torch\.zeros without a device .* device=self\.device"):
        torch.zeros(3)


def test_a_default_device_of_the_users_stands_for_the_argument():
    with torch.device("meta"), ForbidHostReads():
        assert torch.zeros(3).device.type == "meta"


def test_guard_ends_with_its_block_also_after_an_error():
    with pytest.raises(HostReadError), ForbidHostReads():
        NUMBERS[0].item()
    assert NUMBERS[0].item() == 1.0
    assert torch.zeros(2).tolist() == [0.0, 0.0]


# ---- lists as indices ----------------------------------------------------------------------------------------------------


def written(index) -> torch.Tensor:
    grid = GRID.clone()
    grid[index] = -1.0
    return grid


COLUMNS = slice(None)
INDICES = {
    "columns": (COLUMNS, [1, 3]),
    "rows": [2, 0],
    "one": [1],
    "negative": (COLUMNS, [-1, -2]),
    "pairs": ([0, 1], [2, 3]),
    "a tuple": (COLUMNS, (0, 3)),
    "a range": (COLUMNS, range(3)),
    "an array": (COLUMNS, np.array([3, 0])),
    "an array of rows": np.array([2, 0]),
    "two dimensions": (COLUMNS, [[0, 1], [2, 3]]),
    "none": (COLUMNS, []),
    "numpy's numbers": (COLUMNS, [np.int64(1), np.int32(2)]),
    "bools": (COLUMNS, [True, False, False, True]),
    "bools of rows": [True, False, True],
    "no bool": [False, False, False],
    "an array of bools": (COLUMNS, np.array([True, False, False, True])),
    "a mask of all": GRID.numpy() % 2 == 1,
    "bools and numbers": ([True, False, True], [1, 2]),
    "with an ellipsis": (..., [0, 2]),
    "with a new axis": (None, [0, 2]),
    "with a number": (1, [0, 2]),
}


@pytest.mark.parametrize("name", INDICES)
@pytest.mark.usefixtures("inference")
def test_a_list_as_an_index_means_the_same_and_is_made_once(name):
    """In what would be the recording, no tensor may come from the host (`lift_fresh` says one does), and another list than
    those of the rehearsal is refused.
    """
    index = INDICES[name]
    read, write = GRID[index], written(index)
    guard = ForbidHostReads()
    with guard:
        assert GRID[index].shape == read.shape
        written(index)
    count = len(guard.constants)
    assert count >= 1
    with FromHost() as seen, guard.recording():
        read_again, write_again = GRID[index], written(index)
    assert len(guard.constants) == count
    assert [tensor for tensor in seen.tensors if tensor.dim() > 0] == []
    assert read_again.tolist() == read.tolist()
    assert write_again.tolist() == write.tolist()
    with pytest.raises(HostReadError, match="numbers that differ from the previous step's"), guard.recording():
        GRID[[1, 1, 1, 1]]


class FromHost(TorchDispatchMode):
    """Collects the tensors that are made of the host's data."""

    def __init__(self):
        super().__init__()
        self.tensors = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func is torch.ops.aten.lift_fresh.default:
            self.tensors.append(args[0])
        return func(*args, **(kwargs or {}))


def test_tensors_of_numbers_are_copies_of_constants():
    guard = ForbidHostReads()

    def make() -> torch.Tensor:
        return torch.tensor([1.0, 2.0], device=CPU).add_(NUMBERS[:2]) + torch.as_tensor(ARRAY[:2], device=CPU) * 2.0

    with guard:
        first = make()
    with FromHost() as seen, guard.recording():
        second = make()
    assert first.tolist() == second.tolist() == [4.0, 4.0]
    assert seen.tensors == []
    assert len(guard.constants) == 2


def test_a_constant_is_not_shared_between_types_and_devices():
    with ForbidHostReads() as guard:
        kinds = [torch.tensor([1], device=CPU), torch.tensor([1.0], device=CPU), torch.tensor([True], device=CPU)]
        kinds.append(torch.tensor([1], device=CPU, dtype=torch.int32))
        kinds.append(torch.tensor([1], device="meta"))
    assert [(tensor.dtype, tensor.device.type) for tensor in kinds] == [
        (torch.int64, "cpu"),
        (torch.float32, "cpu"),
        (torch.bool, "cpu"),
        (torch.int32, "cpu"),
        (torch.int64, "meta"),
    ]
    assert len(guard.constants) == 5


def test_a_mask_of_the_wrong_length_is_torchs_error():
    with ForbidHostReads(), pytest.raises(IndexError, match="shape of the mask"):
        GRID[[True, False]]


def test_an_index_that_the_constants_made_serves_autograd():
    weights = torch.ones(4, requires_grad=True)
    guard = ForbidHostReads()
    with torch.inference_mode(), guard:
        weights.detach()[[1, 2]]
    with guard:
        weights[[1, 2]].sum().backward()
    assert weights.grad.tolist() == [0.0, 1.0, 1.0, 0.0]
